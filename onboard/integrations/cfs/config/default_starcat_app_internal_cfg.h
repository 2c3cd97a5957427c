/* Settings that only the app depends on.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_INTERNAL_CFG_H
#define STARCAT_APP_INTERNAL_CFG_H

#define STARCAT_APP_PIPE_DEPTH 32
#define STARCAT_APP_PIPE_NAME  "STARCAT_APP_PIPE"
#define STARCAT_APP_TABLE_NAME "Config"

/* Bytes of each of the two slots for images and their parity, which is a 32nd of an image; a
 * multiple of 8. */
#define STARCAT_APP_SLOT_BYTES 4194304

/* Bytes of the largest patch of an image, a multiple of 4. */
#define STARCAT_APP_PATCH_BYTES 262144

/* Whether the mission trusts a new image, which is whole: true, or a check of its signature. */
#ifndef STARCAT_APP_IS_TRUSTED
#define STARCAT_APP_IS_TRUSTED(bytes, size) (((bytes) != NULL) && ((size) > 0u))
#endif

/* Images that are read into the slots at the start. The second one need not be there. */
#define STARCAT_APP_IMAGE_FILE       "/cf/starcat.img"
#define STARCAT_APP_OTHER_IMAGE_FILE "/cf/starcat2.img"

#endif
