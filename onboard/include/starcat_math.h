/* The five functions of libm that the library uses. Each can be replaced: -DSTARCAT_SQRT=my_sqrt,
 * declared in a header of yours: -DSTARCAT_MATH_HEADER='"my_math.h"' instead of <math.h>.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_MATH_H
#define STARCAT_MATH_H

#ifdef STARCAT_MATH_HEADER
#include STARCAT_MATH_HEADER
#else
#include <math.h>
#endif

#ifdef STARCAT_SINGLE
#define STARCAT_LIBM(name) name##f
#else
#define STARCAT_LIBM(name) name
#endif

#ifndef STARCAT_SQRT
#define STARCAT_SQRT STARCAT_LIBM(sqrt)
#endif
#ifndef STARCAT_SIN
#define STARCAT_SIN STARCAT_LIBM(sin)
#endif
#ifndef STARCAT_COS
#define STARCAT_COS STARCAT_LIBM(cos)
#endif
#ifndef STARCAT_ATAN2
#define STARCAT_ATAN2 STARCAT_LIBM(atan2)
#endif
#ifndef STARCAT_LOG
#define STARCAT_LOG STARCAT_LIBM(log)
#endif

#endif
