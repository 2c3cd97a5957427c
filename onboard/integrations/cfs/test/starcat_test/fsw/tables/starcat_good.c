/* SPDX-License-Identifier: MIT */
#include "cfe_tbl_filedef.h"
#include "starcat_app_tbl.h"
#include "starcat_test_values.h"

STARCAT_APP_Config_t Config = {
    .Camera = {512.0, 512.0, 703.35, 256.0, 256.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0},
    .Tolerance_px = 2.0,
    .Noise_px = TEST_NOISE_PX,
    .LogChance = -20.723265836946411,
    .Prior_rad = TEST_PRIOR_RAD,
    .MaxSteps = 4000000,
    .PriorAge_ms = TEST_AGE_MS,
    .ScrubBlocks = 4,
    .LoadPieces = 4,
    .Tracking = 1,
};

CFE_TBL_FILEDEF(Config, STARCAT_APP.Config, A table with its own camera, starcat_good.tbl)
