# SPDX-License-Identifier: MIT
# Headers that a processor may replace by its own, in the mission's definitions.
foreach(FILE internal_cfg platform_cfg perfids msgids)
  generate_config_includefile(
    FILE_NAME     "starcat_app_${FILE}.h"
    FALLBACK_FILE "${CMAKE_CURRENT_LIST_DIR}/config/default_starcat_app_${FILE}.h"
  )
endforeach()
