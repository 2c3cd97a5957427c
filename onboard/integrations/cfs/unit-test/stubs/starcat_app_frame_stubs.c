/* SPDX-License-Identifier: MIT */
#include "starcat_app_stubs.h"

STUB_OF_HANDLER(STARCAT_APP_Frame, STARCAT_APP_FrameTlm_t)
