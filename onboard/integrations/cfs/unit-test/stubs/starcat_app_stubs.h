/* SPDX-License-Identifier: MIT */
#ifndef STARCAT_APP_STUBS_H
#define STARCAT_APP_STUBS_H

#include "starcat_app.h"
#include "utassert.h"
#include "utgenstub.h"
#include "uttest.h"
#include "utstubs.h"

#define STUB_OF_HANDLER(name, type)               \
  void name(const type *Msg) {                    \
    UT_GenStub_AddParam(name, const type *, Msg); \
    UT_GenStub_Execute(name, Basic, NULL);        \
  }

#endif
