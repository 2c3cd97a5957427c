# SPDX-License-Identifier: MIT
# Headers that a mission may replace by its own, in its definitions.
foreach(FILE fcncodes interface_cfg mission_cfg perfids msg msgdefs msgstruct tbl tbldefs topicids)
  generate_config_includefile(
    FILE_NAME     "starcat_app_${FILE}.h"
    FALLBACK_FILE "${CMAKE_CURRENT_LIST_DIR}/config/default_starcat_app_${FILE}.h"
  )
endforeach()
