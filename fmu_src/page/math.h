/* What the sources use of the mathematical library, where there is none (library.c). */
#ifndef PAGE_MATH_H
#define PAGE_MATH_H

#define NAN __builtin_nanf("")
#define INFINITY __builtin_inff()
#define HUGE_VAL __builtin_inf()
#define isfinite(x) __builtin_isfinite(x)
#define isnan(x) __builtin_isnan(x)
#define isinf(x) __builtin_isinf(x)

/* instructions of WebAssembly, or of the compiler's own library */
double fabs(double), sqrt(double), floor(double), ceil(double), trunc(double), nearbyint(double), rint(double);
double fmin(double, double), fmax(double, double), copysign(double, double), fmod(double, double);

/* of library.c */
double ldexp(double, int);
double sin(double), cos(double), tan(double), asin(double), acos(double), atan(double), atan2(double, double);
double sinh(double), cosh(double), tanh(double), asinh(double), acosh(double), atanh(double);
double exp(double), expm1(double), log(double), log1p(double), log10(double), pow(double, double);
double cbrt(double), hypot(double, double);

#endif
