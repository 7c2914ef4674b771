/* onespp.c for x86-64 with AVX-512 (F, BW, DQ and VL) and FMA, whatever the compiler's flags: see its `Engine`. */
#include "onespp.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__)

#define ONESPP_AVX512

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,fma"))), apply_to = function)
#include "onespp.c"
#pragma clang attribute pop
#else
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,fma,prefer-vector-width=512")
#include "onespp.c"
#endif

#endif
