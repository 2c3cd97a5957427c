/* The table STARCAT_APP.Config as it is delivered: the camera of the image, noises that are not
 * stated, every frame lost in space.
 *
 * SPDX-License-Identifier: MIT
 */
#include "cfe_tbl_filedef.h"
#include "starcat_app_tbl.h"

STARCAT_APP_Config_t Config = {
    .Tolerance_px = 2.0,
    .LogChance = -20.723265836946411, /* 1e-9 */
    .Prior_rad = 0.009,
    .MaxSteps = 4000000,
    .PriorAge_ms = 2000,
    .ScrubBlocks = 16,
    .LoadPieces = 16,
    .CameraOfImage = 1,
};

CFE_TBL_FILEDEF(Config, STARCAT_APP.Config, Configuration of starcat, starcat_app_tbl.tbl)
