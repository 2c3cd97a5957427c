/* The table: checked by the library itself, and taken over.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#define REFUSED ((CFE_Status_t)-1)
#define WIDEST_PRIOR_RAD 0.35

void STARCAT_APP_TakeCamera(const STARCAT_APP_Camera_t *From, starcat_camera *Camera) {
  Camera->width_px = (starcat_real)From->Width_px;
  Camera->height_px = (starcat_real)From->Height_px;
  Camera->focal_length_px = (starcat_real)From->FocalLength_px;
  Camera->x0_px = (starcat_real)From->X0_px;
  Camera->y0_px = (starcat_real)From->Y0_px;
  Camera->k1 = (starcat_real)From->K1;
  Camera->k2 = (starcat_real)From->K2;
  Camera->k3 = (starcat_real)From->K3;
  Camera->p1 = (starcat_real)From->P1;
  Camera->p2 = (starcat_real)From->P2;
  Camera->fold_radius = (starcat_real)From->FoldRadius;
}

/* Take the numbers of the library from the table; the rest of the settings stays. */
static void TakeSettings(const STARCAT_APP_Config_t *Config, starcat_settings *Settings) {
  starcat_options *Options = &Settings->options;
  Options->tolerance_px = (starcat_real)Config->Tolerance_px;
  Options->noise_px = (starcat_real)Config->Noise_px;
  Options->noise_mag = (starcat_real)Config->Noise_mag;
  Options->log_chance = (starcat_real)Config->LogChance;
  Options->fov_error = (starcat_real)Config->FovError;
  Settings->max_steps_track = Config->MaxSteps;
  Settings->max_steps_identify = Config->MaxSteps;
  Settings->prior_error_rad = (starcat_real)Config->Prior_rad;
  Settings->blocks_per_tick = Config->ScrubBlocks;
  Settings->has_own_camera = Config->CameraOfImage == 0 ? 1u : 0u;
  STARCAT_APP_TakeCamera(&Config->Camera, &Settings->camera);
}

/* Begin frames with the last attitude, while it is fresh by the table, or with none. */
void STARCAT_APP_SetTracking(uint8 Tracking) {
  const uint64 Age = ((uint64)STARCAT_APP_Data.Config.PriorAge_ms << 32) / 1000u;
  STARCAT_APP_Data.HkTlm.Payload.Tracking = Tracking;
  STARCAT_APP_Data.Settings.prior_age = Tracking != 0 ? Age : 0u;
  STARCAT_APP_Data.Session.has_prior = 0;
}

CFE_Status_t STARCAT_APP_ValidateConfig(void *Table) {
  const STARCAT_APP_Config_t *Config = Table;
  starcat_settings Settings = STARCAT_APP_Data.Settings;
  TakeSettings(Config, &Settings);
  const starcat_status Status = starcat_check_settings(&Settings);
  const bool IsSound = (Config->Prior_rad > 0.0) && (Config->Prior_rad <= WIDEST_PRIOR_RAD) &&
                       (Config->ScrubBlocks > 0) && (Config->LoadPieces > 0) &&
                       (Config->CameraOfImage <= 1) && (Config->Tracking <= 1);
  if ((Status == STARCAT_OK) && IsSound) {
    return CFE_SUCCESS;
  }
  CFE_EVS_SendEvent(STARCAT_APP_TABLE_ERR_EID, CFE_EVS_EventType_ERROR,
                    "STARCAT: the table is refused, status %d%s", (int)Status,
                    IsSound ? "" : ", prior, blocks, pieces or flags out of range");
  return REFUSED;
}

static void TakeConfig(const STARCAT_APP_Config_t *Config) {
  STARCAT_APP_Data.Config = *Config;
  TakeSettings(Config, &STARCAT_APP_Data.Settings);
  STARCAT_APP_SetTracking(Config->Tracking);
  STARCAT_APP_Data.HkTlm.Payload.CameraSource =
      Config->CameraOfImage == 0 ? STARCAT_APP_CAMERA_OF_TABLE : STARCAT_APP_CAMERA_OF_IMAGE;
  CFE_EVS_SendEvent(STARCAT_APP_TABLE_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: the table was taken over");
}

/* Let table services validate, load and dump the table; take it over if it is a new one. */
CFE_Status_t STARCAT_APP_ManageConfig(void) {
  void *Address = NULL;
  (void)CFE_TBL_Manage(STARCAT_APP_Data.Table);
  const CFE_Status_t Status = CFE_TBL_GetAddress(&Address, STARCAT_APP_Data.Table);
  if (Status == CFE_TBL_INFO_UPDATED) {
    TakeConfig(Address);
  }
  if (Status >= CFE_SUCCESS) {
    (void)CFE_TBL_ReleaseAddress(STARCAT_APP_Data.Table);
  }
  return Status < CFE_SUCCESS ? Status : CFE_SUCCESS;
}
