// What StarTracker.cpp and the code that fpp-to-cpp generates for its types take from the framework,
// for a test where the framework is not at hand. A project has the framework's own: nothing of this
// is part of the component.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_TEST_FRAMEWORK_HPP
#define STARCAT_TEST_FRAMEWORK_HPP

#include <cstdint>
#include <cstdio>
#include <string>

using U8 = std::uint8_t;
using U16 = std::uint16_t;
using U32 = std::uint32_t;
using U64 = std::uint64_t;
using I16 = std::int16_t;
using I32 = std::int32_t;
using F32 = float;
using F64 = double;
using FwAssertArgType = I32;
using FwChanIdType = U32;
using FwEnumStoreType = I32;
using FwEventIdType = U32;
using FwIndexType = I16;
using FwOpcodeType = U32;
using FwPrmIdType = U32;
using FwSizeStoreType = U16;
using FwSizeType = U64;

#define FW_ASSERT(condition, ...) \
  do {                            \
    if (!(condition)) {           \
      std::abort();               \
    }                             \
  } while (0)

namespace Fw {

enum SerializeStatus { FW_SERIALIZE_OK, FW_DESERIALIZE_FORMAT_ERROR };
enum class Endianness { BIG };

// Nothing is serialized in the test: handlers are called directly.
class SerialBufferBase {
 public:
  template <class... T>
  SerializeStatus serializeFrom(const T&...) {
    return FW_SERIALIZE_OK;
  }
  template <class... T>
  SerializeStatus deserializeTo(T&...) {
    return FW_SERIALIZE_OK;
  }
};

class LinearBufferBase : public SerialBufferBase {
 public:
  LinearBufferBase(U8*, FwSizeType) {}
};

class Serializable {
 public:
  virtual ~Serializable() = default;
};

class StringBase {
 public:
  StringBase(const char* text) : m_text(text) {}
  virtual ~StringBase() = default;
  const char* toChar() const { return m_text.c_str(); }

 private:
  std::string m_text;
};

class String : public StringBase {
 public:
  using StringBase::StringBase;
};

class CmdStringArg : public StringBase {
 public:
  using StringBase::StringBase;
};

class Time {};
class CmdArgBuffer {};
class LogBuffer {};
class ParamBuffer {};
class TlmBuffer {};

class ParamValid {
 public:
  enum T { UNINIT, VALID };
  ParamValid(T t = UNINIT) : e(t) {}
  T e;
};

class CmdResponse {
 public:
  enum T { OK, EXECUTION_ERROR };
  CmdResponse(T t) : e(t) {}
  T e;
};

class PassiveComponentBase {
 public:
  PassiveComponentBase(const char*) {}
  virtual ~PassiveComponentBase() = default;
};

class ActiveComponentBase : public PassiveComponentBase {
 public:
  using PassiveComponentBase::PassiveComponentBase;
  enum MsgDispatchStatus { MSG_DISPATCH_OK };
};

}  // namespace Fw

namespace Os {

class Mutex {};

class File {
 public:
  enum Mode { OPEN_READ };
  enum Status { OP_OK, OTHER_ERROR };
  Status open(const char* path, Mode) {
    m_file = std::fopen(path, "rb");
    return m_file != nullptr ? OP_OK : OTHER_ERROR;
  }
  Status size(FwSizeType& size) {
    std::fseek(m_file, 0, SEEK_END);
    size = static_cast<FwSizeType>(std::ftell(m_file));
    std::rewind(m_file);
    return OP_OK;
  }
  Status read(U8* buffer, FwSizeType& size) {
    size = std::fread(buffer, 1, size, m_file);
    return OP_OK;
  }
  void close() {
    if (m_file != nullptr) {
      std::fclose(m_file);
    }
    m_file = nullptr;
  }

 private:
  std::FILE* m_file = nullptr;
};

}  // namespace Os

#endif
