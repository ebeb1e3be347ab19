/* What the sources use of the mathematical library, where there is none (library.c). */
#ifndef PAGE_MATH_H
#define PAGE_MATH_H

#define NAN __builtin_nanf("")
#define INFINITY __builtin_inff()
#define HUGE_VAL __builtin_inf()
#define isfinite(x) __builtin_isfinite(x)
#define isnan(x) __builtin_isnan(x)
#define isinf(x) __builtin_isinf(x)

/* instructions of WebAssembly: without the built-in names each would be a call to a function in software */
#define fabs(x) __builtin_fabs(x)
#define sqrt(x) __builtin_sqrt(x)
#define floor(x) __builtin_floor(x)
#define ceil(x) __builtin_ceil(x)
#define trunc(x) __builtin_trunc(x)
#define nearbyint(x) __builtin_nearbyint(x)
#define rint(x) __builtin_rint(x)
#define copysign(x, y) __builtin_copysign(x, y)

/* of the compiler's own library */
double fmin(double, double), fmax(double, double), fmod(double, double);

/* of library.c */
double ldexp(double, int);
double sin(double), cos(double), tan(double), asin(double), acos(double), atan(double), atan2(double, double);
double sinh(double), cosh(double), tanh(double), asinh(double), acosh(double), atanh(double);
double exp(double), expm1(double), log(double), log1p(double), log10(double), pow(double, double);
double cbrt(double), hypot(double, double);

#endif
