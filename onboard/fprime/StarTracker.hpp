// The component of StarTracker.fpp. Memory for the images is the topology's.
//
// SPDX-License-Identifier: MIT
#ifndef Starcat_StarTracker_HPP
#define Starcat_StarTracker_HPP

#include <atomic>

#include "Os/File.hpp"
#include "StarTrackerComponentAc.hpp"
#include "starcat.h"
#include "starcat_update.h"

namespace Starcat {

class StarTracker final : public StarTrackerComponentBase {
 public:
  explicit StarTracker(const char* compName);

  //! Give two places for images and their parity, each of `capacity` bytes at a multiple of 8, and
  //! room for a patch at a multiple of 4, which may be null. Called once, first.
  void configure(U8* first, U8* second, FwSizeType capacity, U8* patch, FwSizeType patchCapacity);

  //! Read the images of the start; the second path may be null. Called once, before the task starts.
  void openImages(const char* path, const char* otherPath);

 private:
  void framesIn_handler(FwIndexType portNum, Starcat::Centroids& centroids) override;
  void schedIn_handler(FwIndexType portNum, U32 context) override;
  void LOAD_IMAGE_cmdHandler(FwOpcodeType opCode, U32 cmdSeq, const Fw::CmdStringArg& path,
                             U32 crc) override;
  void LOAD_PATCH_cmdHandler(FwOpcodeType opCode, U32 cmdSeq,
                             const Fw::CmdStringArg& path) override;
  void SWITCH_IMAGE_cmdHandler(FwOpcodeType opCode, U32 cmdSeq) override;
  void CLEAR_COUNTERS_cmdHandler(FwOpcodeType opCode, U32 cmdSeq) override;
  void parameterUpdated(FwPrmIdType id) override;
  void parametersLoaded() override;

  // Settings
  void takeSettings();
  starcat_status check(const starcat_camera& camera, const starcat_options& options);

  // Frames
  bool isFresh(U64 time_us);
  starcat_status identify(const starcat_frame& frame, bool hasPrior, Mode& mode, U32& steps);
  starcat_status answer(const Centroids& given, Mode& mode, U32& steps);
  void count(U32 sequence, Mode mode, starcat_status status);
  Attitude attitudeOf(const Centroids& given, Mode mode, starcat_status status, U32 steps) const;
  void report() const;

  // Images
  bool beginLoad(const char* path, U32 crc, bool isPatch);
  void readPiece();
  void checkLoaded();
  void scrub();
  void repair(U32 block);
  void endLoad(LoadState state);
  void imageInUse(starcat_status status);
  void readWhole(const char* path, U32 active);

  starcat_places m_places;
  starcat_image m_image;
  starcat_camera m_camera;
  starcat_options m_options;
  starcat_workspace m_work;
  starcat_result m_result;
  starcat_real m_numbers[4][STARCAT_MAX_CENTROIDS];
  U8 m_piece[4096];
  U8* m_patch = nullptr;
  FwSizeType m_patchCapacity = 0;
  bool m_isPatch = false;
  Os::File m_file;

  std::atomic<bool> m_isNew{false};  // settings, to be taken over
  bool m_hasImage = false;
  bool m_hasPrior = false;
  U64 m_priorTime_us = 0;
  starcat_real m_prior[4];
  starcat_status m_imageStatus = STARCAT_E_SHORT;
  LoadState m_load = LoadState::NONE;
  U32 m_loadBytes = 0;
  U32 m_loadSize = 0;
  U32 m_checkBlock = 0;
  U32 m_scrubBlock = 0;

  U32 m_framesIn = 0;
  U32 m_identified = 0;
  U32 m_tracked = 0;
  Counts m_notIdentified;
  U32 m_withoutImage = 0;
  U32 m_errors = 0;
  U32 m_scrubPasses = 0;
  U32 m_damageFound = 0;
  U32 m_blocksMended = 0;
  U32 m_fallBacks = 0;
};

}  // namespace Starcat

#endif
