/* SPDX-License-Identifier: MIT */
#include "cfe_tbl_filedef.h"
#include "starcat_app_tbl.h"

STARCAT_APP_Config_t Config = {
    .Tolerance_px = -2.0, /* the library refuses it */
    .Prior_rad = 0.01,
    .MaxSteps = 4000000,
    .ScrubBlocks = 4,
    .LoadPieces = 4,
    .CameraOfImage = 1,
};

CFE_TBL_FILEDEF(Config, STARCAT_APP.Config, A table to be refused, starcat_bad.tbl)
