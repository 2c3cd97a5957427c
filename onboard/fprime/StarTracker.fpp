# starcat as a component of F Prime: centroids in, attitudes out; images are loaded, scrubbed, mended
# and switched in idle time.
#
# SPDX-License-Identifier: MIT

module Starcat {

  @ Most centroids of a frame; that of the library, STARCAT_MAX_CENTROIDS
  constant MAX_CENTROIDS = 64

  @ starcat_status of starcat.h
  enum Status : I16 {
    IDENTIFIED = 0
    NO_MATCH = 1
    TOO_FEW_STARS = 2
    E_NULL = -1
    E_SHORT = -2
    E_MAGIC = -3
    E_VERSION = -4
    E_BYTE_ORDER = -5
    E_ALIGNMENT = -6
    E_LAYOUT = -7
    E_CRC = -8
    E_CAPACITY = -9
    E_TOO_MANY_CENTROIDS = -10
    E_NOT_FINITE = -11
    E_CAMERA = -12
    E_OPTIONS = -13
    E_BUDGET = -14
  }

  @ starcat_reason of starcat.h: why a frame has no answer
  enum Reason : U8 {
    NONE = 0
    TOO_FEW_STARS = 1
    NO_CANDIDATE = 2
    CHANCE = 3
    SHARE = 4
    SCALE = 5
    STEPS = 6
  }

  @ How a frame was identified
  enum Mode : U8 {
    NONE = 0 @< no image can be used
    IDENTIFY = 1 @< lost in space
    TRACK = 2 @< from the last attitude
  }

  @ How far a new image has come
  enum LoadState : U8 {
    NONE = 0
    READING = 1 @< from its file, a few pieces a tick
    CHECKING = 2 @< its blocks, a few a tick
    READY = 3 @< to be switched to
    FAILED = 4 @< not read, damaged, or not the one that was stated
  }

  array Numbers = [MAX_CENTROIDS] F32
  array Quaternion = [4] F64
  array Covariance = [6] F64
  array Counts = [6] U32

  @ The centroids of a frame
  struct Centroids {
    sequence: U32 @< number of the frame
    seconds: U32 @< middle of the exposure
    microseconds: U32 @< the same
    count: U16 @< how many centroids
    hasMagnitudes: bool
    hasSigmas: bool
    x_px: Numbers @< from the left edge of the detector
    y_px: Numbers @< from the upper edge of the detector
    magnitude: Numbers @< not finite: unknown
    sigma_px: Numbers @< noise on each axis
  }

  @ What a frame came to
  struct Attitude {
    sequence: U32 @< number of the frame
    seconds: U32 @< time of the frame
    microseconds: U32 @< the same
    status: Status
    reason: Reason
    mode: Mode
    matched: U16 @< centroids that are stars of the image
    usable: U16 @< centroids that could be used
    steps: U32 @< steps that were taken
    quaternion: Quaternion @< x, y, z, w: camera = A icrs, A and an example in starcat.h
    covariance_rad2: Covariance @< of turns about the camera's axes: xx, xy, xz, yy, yz, zz
    logChance: F64 @< natural logarithm of the bound on chance
    residual_rad: F64 @< root mean square of the matched centroids
    reducedChiSquare: F64 @< 0: noise is not stated
  }

  @ A camera as starcat_camera has it
  struct Camera {
    width_px: F64
    height_px: F64
    focalLength_px: F64
    x0_px: F64
    y0_px: F64
    k1: F64
    k2: F64
    k3: F64
    p1: F64
    p2: F64
    foldRadius: F64
  }

  @ Settings of the library, which it validates itself
  struct Options {
    tolerance_px: F64
    noise_px: F64
    noise_mag: F64
    logChance: F64
    fovError: F64
    maxSteps: U32 @< of a frame, tracked and identified together
  }

  port Frame(ref centroids: Centroids)
  port Answer(ref attitude: Attitude)

  active component StarTracker {

    @ Frames of a camera
    async input port framesIn: Frame drop

    @ Attitudes, one for each frame
    output port attitudesOut: Answer

    @ Ticks of idle time
    async input port schedIn: Svc.Sched drop

    command recv port cmdIn
    command reg port cmdRegOut
    command resp port cmdResponseOut
    event port eventOut
    text event port textEventOut
    telemetry port tlmOut
    time get port timeGetOut
    param get port prmGetOut
    param set port prmSetOut

    @ Read a file into the place that is not in use; crc as starcat export prints it, 0: any image
    async command LOAD_IMAGE(path: string size 80, crc: U32) opcode 0

    @ Take the other image into use if it is whole; once more falls back
    async command SWITCH_IMAGE opcode 1

    @ Counters become 0
    async command CLEAR_COUNTERS opcode 2

    @ Read a patch, and make the next image of the one in use
    async command LOAD_PATCH(path: string size 80) opcode 3

    @ Whether the camera is that of the image, or that of CAMERA
    param CAMERA_OF_IMAGE: bool default true id 0

    @ The camera in use if CAMERA_OF_IMAGE is false
    param CAMERA: Camera default { width_px = 1024, height_px = 1024, focalLength_px = 2048, \
      x0_px = 512, y0_px = 512 } id 1

    param OPTIONS: Options default { tolerance_px = 2, logChance = -20.723265836946411, \
      maxSteps = 4000000 } id 2

    @ Whether a frame begins with the last attitude
    param TRACKING: bool default false id 3

    @ How far the last attitude may be from the next one, up to 0.35
    param PRIOR_RAD: F64 default 0.009 id 4

    @ An attitude as old or older is no prior
    param PRIOR_AGE_MS: U32 default 2000 id 5

    @ Blocks of 4096 bytes that are checked a tick
    param SCRUB_BLOCKS: U16 default 16 id 6

    @ Pieces of 4096 bytes that are read a tick
    param LOAD_PIECES: U16 default 16 id 7

    event Started(status: Status, name: string size 96) severity activity high \
      format "Image {} ({})"
    event SettingsRefused(status: Status) severity warning high \
      format "Camera or options are refused: {}; the ones before stay in use"
    event LoadBegun(bytes: U32, path: string size 80) severity activity high \
      format "{} bytes of {} are being read"
    event LoadFailed(status: Status, offset: U32) severity warning high \
      format "The new image cannot be read: {}, at byte {}"
    event LoadReady severity activity high format "The new image is whole"
    event LoadRefused(status: Status, $block: U32) severity warning high \
      format "The new image is refused: {}, block {}"
    event Switched(place: U32, name: string size 96) severity activity high \
      format "Place {} is in use, image {}"
    event SwitchRefused(status: Status) severity warning high \
      format "The other image cannot be used: {}; nothing changes"
    event Mended($block: U32, count: U32) severity warning low \
      format "Block {} was damaged; {} blocks were mended"
    event FellBack($block: U32, place: U32) severity warning high \
      format "Block {} is damaged beyond its parity; place {} took over"
    event NoImage(status: Status) severity fatal format "No image can be used: {}"
    event FrameRefused(sequence: U32, status: Status) severity warning low \
      format "Frame {} is refused: {}" throttle 16

    telemetry FramesIn: U32 id 0
    telemetry FramesIdentified: U32 id 1
    telemetry FramesTracked: U32 id 2
    telemetry FramesNotIdentified: Counts id 3
    telemetry FramesWithoutImage: U32 id 4
    telemetry FrameErrors: U32 id 5
    telemetry LastStatus: Status id 6
    telemetry ImageStatus: Status id 7
    telemetry ImageName: string size 96 id 8
    telemetry ActivePlace: U32 id 9
    telemetry Load: LoadState id 10
    telemetry LoadBytes: U32 id 11
    telemetry ScrubBlock: U32 id 12
    telemetry ScrubPasses: U32 id 13
    telemetry DamageFound: U32 id 14
    telemetry BlocksMended: U32 id 15
    telemetry FallBacks: U32 id 16
  }
}
