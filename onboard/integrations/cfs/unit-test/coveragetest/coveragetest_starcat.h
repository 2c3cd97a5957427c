/* What the coverage tests share: each begins with zeros, and so with an image in use.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef COVERAGETEST_STARCAT_H
#define COVERAGETEST_STARCAT_H

#include <string.h>

#include "starcat_app.h"
#include "utassert.h"
#include "utstubs.h"
#include "uttest.h"

#define HK (STARCAT_APP_Data.HkTlm.Payload)
#define SESSION (STARCAT_APP_Data.Session)
#define SETTINGS (STARCAT_APP_Data.Settings)
#define MOST_EVENTS 64

static uint16 Events[MOST_EVENTS]; /* identifiers in order */

static void Setup(void) {
  UT_ResetState(0);
  memset(&STARCAT_APP_Data, 0, sizeof STARCAT_APP_Data);
  memset(Events, 0, sizeof Events);
  UT_SetDataBuffer(UT_KEY(CFE_EVS_SendEvent), Events, sizeof Events, false);
}

static uint16 LastEvent(void) {
  const uint32 Count = UT_GetStubCount(UT_KEY(CFE_EVS_SendEvent));
  return Count == 0 ? 0 : Events[Count - 1];
}

#define IS(found, expected) UtAssert_INT32_EQ((int32)(found), (int32)(expected))
#define CALLED(function, times) UtAssert_STUB_COUNT(function, times)
#define ONCE(function, code) UT_SetDeferredRetcode(UT_KEY(function), 1, (code))
#define LATER(function, call, code) UT_SetDeferredRetcode(UT_KEY(function), (call), (code))
#define ADD(test) UtTest_Add(test, Setup, NULL, #test)

#endif
