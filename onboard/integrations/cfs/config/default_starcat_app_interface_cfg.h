/* What the messages depend on.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_INTERFACE_CFG_H
#define STARCAT_APP_INTERFACE_CFG_H

/* Most centroids of a frame, in plain digits. The app compiles the library for as many. */
#define STARCAT_APP_MAX_CENTROIDS 64

/* Characters of a path in a command, of an image's name in housekeeping; the last may be a zero. */
#define STARCAT_APP_PATH_LEN 64
#define STARCAT_APP_NAME_LEN 96

#endif
