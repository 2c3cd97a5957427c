/* SPDX-License-Identifier: MIT */
#include "starcat_app_stubs.h"

STARCAT_APP_Data_t STARCAT_APP_Data;
