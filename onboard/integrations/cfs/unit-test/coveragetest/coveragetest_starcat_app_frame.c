/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static STARCAT_APP_FrameTlm_t Frame;
static starcat_result Identified, Tracked;

#define OUT (STARCAT_APP_Data.AttitudeTlm.Payload)

/* A frame at a time in seconds, with what the library then says of it, and its steps. */
static void Fly(uint32 Seconds, starcat_status Track, uint32 TrackSteps, starcat_status Identify,
                uint32 Steps) {
  Frame.Payload.Seconds = Seconds;
  Frame.Payload.Sequence++;
  Tracked.steps = TrackSteps;
  Identified.steps = Steps;
  Identified.n_matched = Tracked.n_matched = 6;
  Identified.q_body_from_icrs[3] = Tracked.q_body_from_icrs[3] = 1;
  for (uint32 n = 0; n < 9; n++) {
    Identified.covariance_rad2[n] = (starcat_real)n;
  }
  UT_ResetState(UT_KEY(starcat_track_frame));
  UT_ResetState(UT_KEY(starcat_identify_frame));
  UT_SetDataBuffer(UT_KEY(starcat_track_frame), &Tracked, sizeof Tracked, true);
  UT_SetDataBuffer(UT_KEY(starcat_identify_frame), &Identified, sizeof Identified, true);
  UT_SetDefaultReturnValue(UT_KEY(starcat_track_frame), Track);
  UT_SetDefaultReturnValue(UT_KEY(starcat_identify_frame), Identify);
  STARCAT_APP_Frame(&Frame);
}

static void Begin(void) {
  memset(&Frame, 0, sizeof Frame);
  memset(&Identified, 0, sizeof Identified);
  memset(&Tracked, 0, sizeof Tracked);
  Frame.Payload.Count = 10;
  STARCAT_APP_Data.Options.max_steps = 1000;
  STARCAT_APP_Data.Config.PriorAge_ms = 2000;
}

static void TestIdentified(void) {
  static const double Kept[6] = {0, 1, 2, 4, 5, 8};
  Begin();
  Frame.Payload.Flags = STARCAT_APP_HAS_MAGNITUDES | STARCAT_APP_HAS_SIGMAS;
  Fly(10, STARCAT_NO_MATCH, 0, STARCAT_IDENTIFIED, 500);
  IS(HK.FramesIn, 1);
  IS(HK.FramesIdentified, 1);
  IS(OUT.Sequence, 1);
  IS(OUT.Seconds, 10);
  IS(OUT.Mode, STARCAT_APP_MODE_IDENTIFY);
  IS(OUT.Steps, 500);
  IS(OUT.Matched, 6);
  UtAssert_True(OUT.Quaternion[3] == 1.0, "quaternion");
  UtAssert_True(memcmp(OUT.Covariance_rad2, Kept, sizeof Kept) == 0, "covariance");
  CALLED(CFE_SB_TransmitMsg, 1);
  CALLED(CFE_ES_PerfLogAdd, 2); /* entry and exit */
  CALLED(starcat_track_frame, 0);
  IS(STARCAT_APP_Data.HasPrior, true);
}

static void TestTracked(void) {
  Begin();
  HK.Tracking = 1;
  Fly(10, STARCAT_IDENTIFIED, 100, STARCAT_IDENTIFIED, 500); /* no prior yet */
  Fly(11, STARCAT_IDENTIFIED, 100, STARCAT_IDENTIFIED, 500);
  IS(OUT.Mode, STARCAT_APP_MODE_TRACK);
  IS(OUT.Steps, 100);
  IS(HK.FramesIdentified, 1);
  IS(HK.FramesTracked, 1);
  Fly(10, STARCAT_IDENTIFIED, 100, STARCAT_IDENTIFIED, 500); /* back in time, by little */
  IS(HK.FramesTracked, 2);
  Fly(12, STARCAT_IDENTIFIED, 100, STARCAT_IDENTIFIED, 500); /* too old by now */
  IS(HK.FramesTracked, 2);
  IS(HK.FramesIdentified, 2);
}

static void TestTrackingThatFails(void) {
  Begin();
  HK.Tracking = 1;
  Fly(10, STARCAT_NO_MATCH, 100, STARCAT_IDENTIFIED, 500);
  Fly(11, STARCAT_NO_MATCH, 100, STARCAT_IDENTIFIED, 500); /* lost in space, with what is left */
  IS(OUT.Mode, STARCAT_APP_MODE_IDENTIFY);
  IS(OUT.Steps, 600);
  IS(HK.FramesIdentified, 2);
  Tracked.reason = STARCAT_REASON_STEPS;
  Fly(12, STARCAT_E_BUDGET, 1000, STARCAT_IDENTIFIED, 500); /* nothing is left */
  IS(OUT.Mode, STARCAT_APP_MODE_TRACK);
  IS(OUT.Steps, 1000);
  IS(HK.FramesNotIdentified[STARCAT_REASON_STEPS - 1], 1);
  IS(HK.LastStatus, STARCAT_E_BUDGET);
  UtAssert_True(OUT.Quaternion[3] == 0.0, "no quaternion");
  IS(STARCAT_APP_Data.HasPrior, false);
}

static void TestNotIdentified(void) {
  Begin();
  Identified.reason = STARCAT_REASON_SHARE;
  Fly(10, STARCAT_NO_MATCH, 0, STARCAT_NO_MATCH, 500);
  IS(HK.FramesNotIdentified[STARCAT_REASON_SHARE - 1], 1);
  IS(OUT.Reason, STARCAT_REASON_SHARE);
  IS(OUT.Status, STARCAT_NO_MATCH);
  CALLED(CFE_EVS_SendEvent, 0);
}

static void TestRefused(void) {
  Begin();
  Frame.Payload.Count = 65535;
  Fly(10, STARCAT_NO_MATCH, 0, STARCAT_E_TOO_MANY_CENTROIDS, 0);
  IS(HK.FrameErrors, 1);
  IS(LastEvent(), STARCAT_APP_FRAME_ERR_EID);
  Identified.reason = 7; /* which no library says */
  Fly(11, STARCAT_NO_MATCH, 0, STARCAT_NO_MATCH, 0);
  Identified.reason = STARCAT_REASON_NONE;
  Fly(12, STARCAT_NO_MATCH, 0, STARCAT_NO_MATCH, 0);
  IS(HK.FrameErrors, 3);
  IS(HK.FramesIn, 3);
}

static void TestWithoutImage(void) {
  Begin();
  STARCAT_APP_Data.HasImage = false;
  HK.ImageStatus = STARCAT_E_CRC;
  Fly(10, STARCAT_IDENTIFIED, 0, STARCAT_IDENTIFIED, 0);
  IS(HK.FramesWithoutImage, 1);
  IS(OUT.Status, STARCAT_E_CRC);
  IS(OUT.Mode, STARCAT_APP_MODE_NONE);
  IS(OUT.Matched, 0);
  CALLED(starcat_identify_frame, 0);
  CALLED(CFE_SB_TransmitMsg, 1);
}

void UtTest_Setup(void) {
  ADD(TestIdentified);
  ADD(TestTracked);
  ADD(TestTrackingThatFails);
  ADD(TestNotIdentified);
  ADD(TestRefused);
  ADD(TestWithoutImage);
}
