/* onespp.c for x86-64 with AVX2 and FMA, whatever the compiler's flags: see its `Engine`. */
#include "onespp.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__)

#define ONESPP_AVX2

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#include "onespp.c"
#pragma clang attribute pop
#else
#pragma GCC target("avx2,fma")
#include "onespp.c"
#endif

#endif
