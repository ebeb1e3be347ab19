/* What a compiler without a C library has of <math.h> (compiler-rt), and generated steps need */
#ifndef PSA_TEST_MATH_H
#define PSA_TEST_MATH_H

double exp(double), log(double), sqrt(double), fabs(double), sin(double), cos(double), tan(double);
float expf(float), logf(float), sqrtf(float), fabsf(float), sinf(float), cosf(float), tanf(float);

#endif
