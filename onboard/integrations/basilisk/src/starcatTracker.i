// SPDX-License-Identifier: MIT
%module starcatTracker

%include "architecture/utilities/bskException.swg"
%default_bsk_exception();

%{
#include "starcatTracker.h"
%}

%pythoncode %{
from Basilisk.architecture.swig_common_model import *
%}
%include "swig_conly_data.i"
%include "std_string.i"
%include "std_vector.i"
%include "swig_eigen.i"
%template(DoubleVector) std::vector<double>;
%template(LongLongVector) std::vector<long long>;

%import "sys_model.i"
%include "starcatTracker.h"

%include "architecture/msgPayloadDefC/NavAttMsgPayload.h"
struct NavAttMsg_C;
%include "architecture/msgPayloadDefC/NavTransMsgPayload.h"
struct NavTransMsg_C;
%include "architecture/msgPayloadDefC/SCStatesMsgPayload.h"
struct SCStatesMsg_C;
%include "architecture/msgPayloadDefC/STAttMsgPayload.h"
struct STAttMsg_C;
%include "architecture/msgPayloadDefC/STSensorMsgPayload.h"
struct STSensorMsg_C;
%include "architecture/msgPayloadDefC/SpicePlanetStateMsgPayload.h"
struct SpicePlanetStateMsg_C;
%include "StarcatFrameMsgPayload.h"

%pythoncode %{
import sys
protectAllClasses(sys.modules[__name__])
%}
