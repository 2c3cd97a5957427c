/* Configuration of the processor.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_PLATFORM_CFG_H
#define STARCAT_APP_PLATFORM_CFG_H

#include "starcat_app_mission_cfg.h"
#include "starcat_app_internal_cfg.h"

#endif
