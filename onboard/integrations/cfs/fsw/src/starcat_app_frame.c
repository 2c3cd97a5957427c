/* A frame to an attitude.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define HK (STARCAT_APP_Data.HkTlm.Payload)

static uint64 TimeOf(const STARCAT_APP_FrameTlm_Payload_t *Given) {
  return ((uint64)Given->Seconds << 32) | Given->Subseconds;
}

/* Whether the last attitude is fresh enough to begin with; the frames may come in any order. */
static bool IsFresh(uint64 Time) {
  const uint64 Last = STARCAT_APP_Data.PriorTime;
  const uint64 Apart = Time > Last ? Time - Last : Last - Time;
  return STARCAT_APP_Data.HasPrior &&
         (Apart < ((uint64)STARCAT_APP_Data.Config.PriorAge_ms << 32) / 1000u);
}

/* Identify: from the last attitude where there is one, and lost in space with the steps that are
 * left if that fails. */
static starcat_status Identify(const starcat_frame *Frame, bool HasPrior, uint8 *Mode,
                               uint32 *Steps) {
  STARCAT_APP_Data_t *Data = &STARCAT_APP_Data;
  starcat_options Options = Data->Options;
  starcat_status Status = STARCAT_NO_MATCH;
  *Mode = STARCAT_APP_MODE_TRACK;
  *Steps = 0;
  if (HasPrior) {
    Status = starcat_track_frame(&Data->Image, &Data->Camera, &Options, Frame, Data->Prior,
                           (starcat_real)Data->Config.Prior_rad, &Data->Work, &Data->Result);
    *Steps = Data->Result.steps;
    if ((Status == STARCAT_IDENTIFIED) || (*Steps >= Options.max_steps)) {
      return Status;
    }
    Options.max_steps -= *Steps;
  }
  *Mode = STARCAT_APP_MODE_IDENTIFY;
  Status =
      starcat_identify_frame(&Data->Image, &Data->Camera, &Options, Frame, &Data->Work, &Data->Result);
  *Steps += Data->Result.steps;
  return Status;
}

static starcat_status Answer(const STARCAT_APP_FrameTlm_Payload_t *Given, uint8 *Mode,
                             uint32 *Steps) {
  static starcat_real Numbers[4][STARCAT_APP_MAX_CENTROIDS];
  const starcat_frame Frame = {
      Given->Count, Numbers[0], Numbers[1],
      (Given->Flags & STARCAT_APP_HAS_MAGNITUDES) != 0 ? Numbers[2] : NULL,
      (Given->Flags & STARCAT_APP_HAS_SIGMAS) != 0 ? Numbers[3] : NULL};
  for (uint32 n = 0; (n < Given->Count) && (n < STARCAT_APP_MAX_CENTROIDS); n++) {
    Numbers[0][n] = (starcat_real)Given->X_px[n];
    Numbers[1][n] = (starcat_real)Given->Y_px[n];
    Numbers[2][n] = (starcat_real)Given->Magnitude[n];
    Numbers[3][n] = (starcat_real)Given->Sigma_px[n];
  }
  return Identify(&Frame, (HK.Tracking != 0) && IsFresh(TimeOf(Given)), Mode, Steps);
}

static void Count(uint32 Sequence, uint8 Mode, starcat_status Status, uint32 Reason) {
  HK.LastStatus = (int16)Status;
  if (Mode == STARCAT_APP_MODE_NONE) {
    HK.FramesWithoutImage++;
  } else if (Status == STARCAT_IDENTIFIED) {
    if (Mode == STARCAT_APP_MODE_TRACK) {
      HK.FramesTracked++;
    } else {
      HK.FramesIdentified++;
    }
  } else if (((Status > 0) || (Status == STARCAT_E_BUDGET)) && (Reason > 0u) && (Reason <= 6u)) {
    HK.FramesNotIdentified[Reason - 1u]++;
  } else {
    HK.FrameErrors++;
    CFE_EVS_SendEvent(STARCAT_APP_FRAME_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: frame %lu is refused with status %d", (unsigned long)Sequence,
                      (int)Status);
  }
}

/* The numbers of an attitude: those of the result, or zeros. */
static void Fill(STARCAT_APP_AttitudeTlm_Payload_t *Out, const starcat_result *Result) {
  static const uint8 Kept[6] = {0, 1, 2, 4, 5, 8}; /* the others are the same by symmetry */
  const bool IsIdentified = Out->Status == STARCAT_IDENTIFIED;
  for (uint32 n = 0; n < 4u; n++) {
    Out->Quaternion[n] = IsIdentified ? (double)Result->q_body_from_icrs[n] : 0.0;
  }
  for (uint32 n = 0; n < 6u; n++) {
    Out->Covariance_rad2[n] = IsIdentified ? (double)Result->covariance_rad2[Kept[n]] : 0.0;
  }
  Out->LogChance = IsIdentified ? (double)Result->log_chance : 0.0;
  Out->Residual_rad = IsIdentified ? (double)Result->residual_rad : 0.0;
  Out->ReducedChiSquare = IsIdentified ? (double)Result->reduced_chi_square : 0.0;
}

void STARCAT_APP_Frame(const STARCAT_APP_FrameTlm_t *Msg) {
  STARCAT_APP_AttitudeTlm_Payload_t *Out = &STARCAT_APP_Data.AttitudeTlm.Payload;
  starcat_result *Result = &STARCAT_APP_Data.Result;
  starcat_status Status = (starcat_status)HK.ImageStatus;
  uint8 Mode = STARCAT_APP_MODE_NONE;
  uint32 Steps = 0;
  HK.FramesIn++;
  Result->n_matched = 0;
  Result->n_usable = 0;
  Result->reason = STARCAT_REASON_NONE;
  CFE_ES_PerfLogEntry(STARCAT_APP_IDENTIFY_PERF_ID);
  if (STARCAT_APP_Data.HasImage) {
    Status = Answer(&Msg->Payload, &Mode, &Steps);
  }
  CFE_ES_PerfLogExit(STARCAT_APP_IDENTIFY_PERF_ID);
  Count(Msg->Payload.Sequence, Mode, Status, Result->reason);
  Out->Sequence = Msg->Payload.Sequence;
  Out->Seconds = Msg->Payload.Seconds;
  Out->Subseconds = Msg->Payload.Subseconds;
  Out->Status = (int16)Status;
  Out->Reason = (uint8)Result->reason;
  Out->Mode = Mode;
  Out->Matched = (uint16)Result->n_matched;
  Out->Usable = (uint16)Result->n_usable;
  Out->Steps = Steps;
  Fill(Out, Result);
  STARCAT_APP_Data.HasPrior = Status == STARCAT_IDENTIFIED;
  if (STARCAT_APP_Data.HasPrior) {
    memcpy(STARCAT_APP_Data.Prior, Result->q_body_from_icrs, sizeof STARCAT_APP_Data.Prior);
    STARCAT_APP_Data.PriorTime = TimeOf(&Msg->Payload);
  }
  CFE_SB_TimeStampMsg(CFE_MSG_PTR(STARCAT_APP_Data.AttitudeTlm.TelemetryHeader));
  CFE_SB_TransmitMsg(CFE_MSG_PTR(STARCAT_APP_Data.AttitudeTlm.TelemetryHeader), true);
}
