/* SPDX-License-Identifier: MIT */
#include "starcat_app_stubs.h"

STUB_OF_HANDLER(STARCAT_APP_TaskPipe, CFE_SB_Buffer_t)
