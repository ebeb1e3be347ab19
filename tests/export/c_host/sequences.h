/* Calling sequences for a sanitizer or valgrind: legal, illegal, with null pointers and wrong sizes. The
   sources of an FMU are compiled into the same program, so that every access in them is watched. */
#ifndef SEQUENCES_H
#define SEQUENCES_H

#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>

/* End the program unless a condition holds. */
#define CHECK(condition)                                                                       \
    do {                                                                                       \
        if (!(condition)) {                                                                    \
            fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition);      \
            exit(1);                                                                           \
        }                                                                                      \
    } while (0)

/* What each version of FMI has to provide, in sequences_fmi2.c and sequences_fmi3.c. */
void *make_slave(void);                            /* a co-simulation instance in step mode */
void advance_slave(void *slave, int step);         /* one step of 0.1 ms under a moving voltage */
double read_slave(void *slave);                    /* its displacement [m] */
void free_slave(void *slave);
void exchange_model(void);                         /* model exchange, every call of it, legally */
void keep_states(void *slave);                     /* snapshots, their bytes, damaged bytes */
void call_without_instance(void);
void call_illegally(void);
void differentiate(void *slave);                   /* directional, adjoint, output derivatives */
void step_without_allocation(void *slave, int step); /* all calls of a master's loop */

/* Value reference of a variable, by its name. */
unsigned reference(const char *name);
/* The voltage of a step [V]. */
double voltage_of(int step);

#endif
