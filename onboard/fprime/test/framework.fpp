# What StarTracker.fpp takes from the framework, for fpp-check where the framework is not at hand:
# types and ports by name only. A project has the framework's own.
#
# SPDX-License-Identifier: MIT

type FwChanIdType = U32
type FwEventIdType = U32
type FwIndexType = I16
type FwOpcodeType = U32
type FwPacketDescriptorType = U32
type FwPrmIdType = U32
type FwSizeStoreType = U16
type FwSizeType = U64
type FwTimeBaseStoreType = U16
type FwTimeContextStoreType = U8

module Fw {
  port Cmd
  port CmdReg
  port CmdResponse
  port Log
  port LogText
  port PrmGet
  port PrmSet
  port Time
  port Tlm
}

module Svc {
  port Sched(context: U32)
}
