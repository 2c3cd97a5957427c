/* A frame to an attitude.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#define SESSION (STARCAT_APP_Data.Session)

/* Give a frame to the session, in the numbers of the library. */
static starcat_status Answer(const STARCAT_APP_FrameTlm_Payload_t *Given) {
  static starcat_real Numbers[4][STARCAT_APP_MAX_CENTROIDS];
  const starcat_frame Frame = {Given->Count, Numbers[0], Numbers[1],
                               (Given->Flags & STARCAT_APP_HAS_MAGNITUDES) != 0 ? Numbers[2] : NULL,
                               (Given->Flags & STARCAT_APP_HAS_SIGMAS) != 0 ? Numbers[3] : NULL};
  for (uint32 n = 0; (n < Given->Count) && (n < STARCAT_APP_MAX_CENTROIDS); n++) {
    Numbers[0][n] = (starcat_real)Given->X_px[n];
    Numbers[1][n] = (starcat_real)Given->Y_px[n];
    Numbers[2][n] = (starcat_real)Given->Magnitude[n];
    Numbers[3][n] = (starcat_real)Given->Sigma_px[n];
  }
  return starcat_answer_frame(&SESSION, &Frame, ((uint64)Given->Seconds << 32) | Given->Subseconds,
                              &STARCAT_APP_Data.Answer);
}

/* Fill in the attitude of the result, or zeros. */
static void Fill(STARCAT_APP_AttitudeTlm_Payload_t *Out, const starcat_result *Result) {
  static const uint8 Kept[6] = {0, 1, 2, 4, 5, 8}; /* the other elements are equal by symmetry */
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
  const starcat_result *Result = &STARCAT_APP_Data.Answer.result;
  const uint32 Refused = SESSION.counts.frames_refused;
  STARCAT_APP_Data.HkTlm.Payload.FramesIn++;
  CFE_ES_PerfLogEntry(STARCAT_APP_IDENTIFY_PERF_ID);
  const starcat_status Status = Answer(&Msg->Payload);
  CFE_ES_PerfLogExit(STARCAT_APP_IDENTIFY_PERF_ID);
  STARCAT_APP_Data.HkTlm.Payload.LastStatus = (int16)Status;
  if (SESSION.counts.frames_refused != Refused) {
    CFE_EVS_SendEvent(STARCAT_APP_FRAME_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: frame %lu is refused with status %d",
                      (unsigned long)Msg->Payload.Sequence, (int)Status);
  }
  Out->Sequence = Msg->Payload.Sequence;
  Out->Seconds = Msg->Payload.Seconds;
  Out->Subseconds = Msg->Payload.Subseconds;
  Out->Status = (int16)Status;
  Out->Reason = (uint8)Result->reason;
  Out->Mode = (uint8)STARCAT_APP_Data.Answer.mode;
  Out->Matched = (uint16)Result->n_matched;
  Out->Usable = (uint16)Result->n_usable;
  Out->Steps = STARCAT_APP_Data.Answer.steps;
  Fill(Out, Result);
  CFE_SB_TimeStampMsg(CFE_MSG_PTR(STARCAT_APP_Data.AttitudeTlm.TelemetryHeader));
  CFE_SB_TransmitMsg(CFE_MSG_PTR(STARCAT_APP_Data.AttitudeTlm.TelemetryHeader), true);
}
