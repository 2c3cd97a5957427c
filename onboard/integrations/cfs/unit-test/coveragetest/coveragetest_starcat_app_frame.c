/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static STARCAT_APP_FrameTlm_t Frame;
static starcat_result Result;

#define OUT (STARCAT_APP_Data.AttitudeTlm.Payload)

/* A frame, and the status that the session then returns. */
static void Fly(uint16 Count, starcat_status Status) {
  memset(&Frame, 0, sizeof Frame);
  Frame.Payload.Sequence = 7;
  Frame.Payload.Seconds = 10;
  Frame.Payload.Subseconds = 5;
  Frame.Payload.Count = Count;
  Frame.Payload.Flags = Count == 10 ? STARCAT_APP_HAS_MAGNITUDES | STARCAT_APP_HAS_SIGMAS : 0;
  Result.n_matched = 6;
  Result.q_body_from_icrs[3] = 1;
  for (uint32 n = 0; n < 9; n++) {
    Result.covariance_rad2[n] = (starcat_real)n;
  }
  UT_SetDataBuffer(UT_KEY(starcat_answer_frame), &Result, sizeof Result, true);
  ONCE(starcat_answer_frame, Status);
  STARCAT_APP_Frame(&Frame);
}

static void TestIdentified(void) {
  static const double Kept[6] = {0, 1, 2, 4, 5, 8};
  STARCAT_APP_Data.Answer.mode = STARCAT_MODE_TRACK;
  STARCAT_APP_Data.Answer.steps = 500;
  Fly(10, STARCAT_IDENTIFIED);
  IS(HK.FramesIn, 1);
  IS(HK.LastStatus, STARCAT_IDENTIFIED);
  IS(OUT.Sequence, 7);
  IS(OUT.Seconds, 10);
  IS(OUT.Subseconds, 5);
  IS(OUT.Mode, STARCAT_APP_MODE_TRACK);
  IS(OUT.Steps, 500);
  IS(OUT.Matched, 6);
  UtAssert_True(SESSION.prior_time == (((uint64)10 << 32) | 5), "time");
  UtAssert_True(OUT.Quaternion[3] == 1.0, "quaternion");
  UtAssert_True(memcmp(OUT.Covariance_rad2, Kept, sizeof Kept) == 0, "covariance");
  CALLED(CFE_SB_TransmitMsg, 1);
  CALLED(CFE_ES_PerfLogAdd, 2); /* entry and exit */
  CALLED(CFE_EVS_SendEvent, 0);
}

static void TestNotIdentified(void) {
  Result.reason = STARCAT_REASON_SHARE;
  Fly(9, STARCAT_NO_MATCH);
  IS(OUT.Reason, STARCAT_REASON_SHARE);
  IS(OUT.Status, STARCAT_NO_MATCH);
  UtAssert_True(OUT.Quaternion[3] == 0.0, "no quaternion");
  CALLED(CFE_EVS_SendEvent, 0);
}

static void TestRefused(void) {
  Fly(65535, STARCAT_E_TOO_MANY_CENTROIDS);
  IS(HK.LastStatus, STARCAT_E_TOO_MANY_CENTROIDS);
  IS(LastEvent(), STARCAT_APP_FRAME_ERR_EID);
  CALLED(CFE_SB_TransmitMsg, 1);
}

void UtTest_Setup(void) {
  ADD(TestIdentified);
  ADD(TestNotIdentified);
  ADD(TestRefused);
}
