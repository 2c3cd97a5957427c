/* Identifiers of the performance log.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_PERFIDS_H
#define STARCAT_APP_PERFIDS_H

#define STARCAT_APP_PERF_ID          94 /* the task, as it does anything */
#define STARCAT_APP_IDENTIFY_PERF_ID 95 /* a frame */
#define STARCAT_APP_SCRUB_PERF_ID    96 /* a tick of idle time: scrubbing, or loading an image */

#endif
