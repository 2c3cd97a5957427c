/* The table and its file.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_TBL_H
#define STARCAT_APP_TBL_H

#include "starcat_app_tbldefs.h"

#define STARCAT_APP_TABLE_FILE "/cf/starcat_app_tbl.tbl"

#endif
