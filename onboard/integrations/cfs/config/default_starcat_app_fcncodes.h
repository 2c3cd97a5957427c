/* Function codes of the commands.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_FCNCODES_H
#define STARCAT_APP_FCNCODES_H

#define STARCAT_APP_NOOP_CC             0
#define STARCAT_APP_RESET_COUNTERS_CC   1
#define STARCAT_APP_LOAD_IMAGE_CC       2
#define STARCAT_APP_SWITCH_IMAGE_CC     3
#define STARCAT_APP_SET_CAMERA_CC       4
#define STARCAT_APP_ENABLE_TRACKING_CC  5
#define STARCAT_APP_DISABLE_TRACKING_CC 6
#define STARCAT_APP_SET_BUDGET_CC       7
#define STARCAT_APP_LOAD_PATCH_CC       8

#endif
