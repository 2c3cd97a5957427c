/* Events.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_EVENTIDS_H
#define STARCAT_APP_EVENTIDS_H

#define STARCAT_APP_INIT_INF_EID     1  /* started; which image is in use */
#define STARCAT_APP_PIPE_ERR_EID     2  /* the pipe cannot be made, subscribed to or read: the app ends */
#define STARCAT_APP_MID_ERR_EID      3  /* a message of another identifier */
#define STARCAT_APP_CC_ERR_EID       4  /* a command of another code */
#define STARCAT_APP_LEN_ERR_EID      5  /* a message of another length */
#define STARCAT_APP_NOOP_INF_EID     6
#define STARCAT_APP_RESET_INF_EID    7
#define STARCAT_APP_TABLE_INF_EID    8  /* the table was taken over */
#define STARCAT_APP_TABLE_ERR_EID    9  /* the table cannot be had, or was refused */
#define STARCAT_APP_CAMERA_INF_EID   10
#define STARCAT_APP_CAMERA_ERR_EID   11 /* a camera that the library refuses */
#define STARCAT_APP_TRACKING_INF_EID 12
#define STARCAT_APP_BUDGET_INF_EID   13
#define STARCAT_APP_BUDGET_ERR_EID   14 /* a budget that the library refuses */
#define STARCAT_APP_LOAD_INF_EID     15 /* an image, or a patch, is being read */
#define STARCAT_APP_LOAD_ERR_EID     16 /* it cannot be read, or does not fit */
#define STARCAT_APP_READY_INF_EID    17 /* it was read and is whole */
#define STARCAT_APP_REFUSED_ERR_EID  18 /* damaged, for another image, or not the stated one */
#define STARCAT_APP_SWITCH_INF_EID   19 /* another image is in use */
#define STARCAT_APP_SWITCH_ERR_EID   20 /* the other image cannot be used; nothing changes */
#define STARCAT_APP_MENDED_INF_EID   21 /* damage of the image in use, made good */
#define STARCAT_APP_FALLBACK_ERR_EID 22 /* damage that could not be: the other image took over */
#define STARCAT_APP_NO_IMAGE_ERR_EID 23 /* no image can be used; frames are answered with its status */
#define STARCAT_APP_OTHER_ERR_EID    25 /* damage of the other image: nothing is left to fall back to */
#define STARCAT_APP_FRAME_ERR_EID    24 /* a frame was refused; the first 16 times */

#endif
