// SPDX-License-Identifier: MIT
%module starcatFilter

%include "architecture/utilities/bskException.swg"
%default_bsk_exception();

%{
#include "starcatFilter.h"
%}

%pythoncode %{
from Basilisk.architecture.swig_common_model import *
%}
%include "swig_conly_data.i"

%import "sys_model.i"
%include "starcatFilter.h"

%include "architecture/msgPayloadDefC/IMUSensorMsgPayload.h"
struct IMUSensorMsg_C;
%include "architecture/msgPayloadDefC/NavAttMsgPayload.h"
struct NavAttMsg_C;
%include "StarcatFrameMsgPayload.h"

%pythoncode %{
import sys
protectAllClasses(sys.modules[__name__])
%}
