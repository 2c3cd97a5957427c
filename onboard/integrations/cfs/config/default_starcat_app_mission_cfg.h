/* Configuration of the mission.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_MISSION_CFG_H
#define STARCAT_APP_MISSION_CFG_H

#include "starcat_app_interface_cfg.h"

#endif
