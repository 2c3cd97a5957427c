/* The messages.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_MSG_H
#define STARCAT_APP_MSG_H

#include "starcat_app_mission_cfg.h"
#include "starcat_app_msgdefs.h"
#include "starcat_app_msgstruct.h"

#endif
