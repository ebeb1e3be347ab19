/* Runs all sequences of sequences.h, once; then many instances, several threads, and a count of the
   allocations that a master's loop makes (none). INSTANCES and STEPS may be given smaller numbers for a
   guard that is slow, STACK bytes to the threads. */
#include "sequences.h"

#include <pthread.h>
#include <string.h>

#include "fmi_data.h"

#if !defined(INSTANCES)
#define INSTANCES 1000
#endif
#if !defined(STEPS)
#define STEPS 100
#endif
#define THREADS 8

unsigned reference(const char *name) {
    for (unsigned vr = 0; vr < PSA_VARIABLES; ++vr)
        if (!strcmp(psa_variables[vr].name, name)) return vr + 1;
    fprintf(stderr, "there is no variable %s\n", name);
    exit(1);
}

double voltage_of(int step) { return 10.0 + 4.0 * (step % 20) + (step > 50 ? 15.0 : 0.0); }

/* Every allocation of the program, if it was linked with -Wl,--wrap for these functions. */
static long allocations;
#if defined(COUNT_ALLOCATIONS)
void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *memory, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *memory, size_t size);

void *__wrap_malloc(size_t size) {
    ++allocations;
    return __real_malloc(size);
}

void *__wrap_calloc(size_t count, size_t size) {
    ++allocations;
    return __real_calloc(count, size);
}

void *__wrap_realloc(void *memory, size_t size) {
    ++allocations;
    return __real_realloc(memory, size);
}
#endif

static void many_instances(void) {
    static void *slaves[INSTANCES];
    for (int i = 0; i < INSTANCES; ++i) slaves[i] = make_slave();
    for (int step = 0; step < 3; ++step)
        for (int i = 0; i < INSTANCES; ++i) advance_slave(slaves[i], step);
    for (int i = 1; i < INSTANCES; ++i) CHECK(read_slave(slaves[i]) == read_slave(slaves[0]));
    for (int i = 0; i < INSTANCES; ++i) free_slave(slaves[i]);
}

static void *run_alone(void *result) {
    void *const slave = make_slave();
    for (int step = 0; step < STEPS; ++step) {
        advance_slave(slave, step);
        if (step % 25 == 0) keep_states(slave);
    }
    differentiate(slave);
    *(double *)result = read_slave(slave);
    free_slave(slave);
    return NULL;
}

static void many_threads(void) {
    pthread_t threads[THREADS];
    pthread_attr_t attributes;
    double alone, found[THREADS];
    CHECK(!pthread_attr_init(&attributes));
#if defined(STACK)
    CHECK(!pthread_attr_setstacksize(&attributes, STACK));
#endif
    run_alone(&alone);
    CHECK(alone > 1e-6);
    for (int i = 0; i < THREADS; ++i)
        CHECK(!pthread_create(&threads[i], &attributes, run_alone, &found[i]));
    for (int i = 0; i < THREADS; ++i) {
        CHECK(!pthread_join(threads[i], NULL));
        CHECK(found[i] == alone);
    }
}

static void no_allocation(void) {
    const long before = allocations;
    void *const slave = make_slave();
#if defined(COUNT_ALLOCATIONS)
    CHECK(allocations == before + 1); /* the instance itself: the count works */
#endif
    const long made = allocations;
    for (int step = 0; step < STEPS; ++step) step_without_allocation(slave, step);
    CHECK(allocations == made);
    free_slave(slave);
    (void)before;
}

int main(void) {
    void *slave = make_slave();
    for (int step = 0; step < STEPS; ++step) advance_slave(slave, step);
    differentiate(slave);
    keep_states(slave);
    free_slave(slave);
    exchange_model();
    call_without_instance();
    call_illegally();
    no_allocation();
    many_instances();
    many_threads();
    puts("all sequences done");
    return 0;
}
