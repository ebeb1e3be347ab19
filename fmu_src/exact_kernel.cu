/* Exact steps on a processor of which every thread runs one set of parameters by itself: CUDA C++.

   A thread's state, the step under trial and the matrices of the last lengths of step are its own: the threads
   of a warp have theirs side by side in memory. So is the matrices' ladder where it is small; a larger one lies
   in a room of the memory that the caller gives, where each thread reads by itself and a set-up takes five times
   as long. A set that cannot be integrated is nan from there on, as in lanes. */
#ifndef PSA_EXACT_KERNEL
#define PSA_EXACT_KERNEL

#define PSA_DEVICE 1
#define PSA_LANES 1
#if defined(__CUDACC_RTC__)
typedef long long int64_t;
typedef unsigned long long uint64_t;
#define NAN __longlong_as_double(0x7FF8000000000000LL)
#endif

#include "exact.c"

#define OWN_ROOM 32768 /* bytes of a ladder that a thread has by itself */

/* Bytes of a thread's room, 0 where it needs none beside its own */
extern "C" __global__ void psa_exact_room(int lengths, int finest, long long *size) {
    psa_exact run;
    psa_state state;
    memset(&run, 0, sizeof run);
    run.lengths = lengths;
    run.finest = finest;
    state.run = &run;
    state.thetas = 0;
    const long long needed = (long long)cut(&state, NULL);
    *size = needed > OWN_ROOM ? needed : 0;
}

/* What is kept of a displacement: least, largest and last value, sum of the squares of its distances from `meant` */
typedef struct {
    double least, largest, last, squares;
} psa_summary;

/* Take in the output at a sample; 1 where it is not finite */
static int take_in(const psa_state *state, long sample, const double *meant, psa_summary *kept) {
    double v[EX_NU + 1], out[EX_SHOWN_OUT];
    for (int j = 0; j < EX_NU; ++j) v[j] = state->run->v[sample * EX_NU + j];
    ex_shown(state->t, state->x, v, 0.0, state->k, out);
    const double shown = out[0], apart = shown - meant[sample];
    if (!isfinite(shown)) return 1;
    if (sample == 0 || shown < kept->least) kept->least = shown;
    if (sample == 0 || shown > kept->largest) kept->largest = shown;
    kept->last = shown;
    kept->squares += apart * apart;
    return 0;
}

/* One set of `sets` a thread: its numbers stand in p [np][sets], x0 and nominal [nx][sets]. Writes a summary
   [4][sets], and the displacement [samples][sets] where it is not NULL. */
extern "C" __global__ void psa_exact_sets(
    long long sets, long long samples, const double *t, const double *v, int zero_order_hold, int lengths,
    const double *length, const int *which_step, const double *p, const double *x0, const double *nominal,
    double tolerance, int finest, long long steps_limit, const double *meant, char *rooms, long long room,
    double *summary, double *shown) {
    const long long set = (long long)blockIdx.x * blockDim.x + threadIdx.x;
    if (set >= sets) return;
    double own[EX_NP + 2 * EX_NX];
    for (int i = 0; i < EX_NP; ++i) own[i] = p[i * sets + set];
    for (int i = 0; i < EX_NX; ++i) own[EX_NP + i] = x0[i * sets + set];
    for (int i = 0; i < EX_NX; ++i) own[EX_NP + EX_NX + i] = nominal[i * sets + set];
    psa_exact run;
    memset(&run, 0, sizeof run);
    run.samples = (long)samples, run.t = t, run.v = v, run.zero_order_hold = zero_order_hold;
    run.lengths = lengths, run.length = length, run.which_step = which_step, run.sets = 1;
    run.p = own, run.x0 = own + EX_NP, run.nominal = own + EX_NP + EX_NX;
    run.tolerance = tolerance, run.finest = finest, run.steps_limit = (long)steps_limit;
    psa_state state;
    psa_pace pace;
    psa_summary kept;
    memset(&state, 0, sizeof state);
    memset(&pace, 0, sizeof pace);
    memset(&kept, 0, sizeof kept);
    state.run = &run;
    for (int i = 0; i < PSA_HELD; ++i) state.held_at[i] = -1;
    double ladder[OWN_ROOM / sizeof(double)];
    cut(&state, room > 0 ? rooms + set * room : (char *)ladder);
    int status = set_up(&state);
    state.t = t[0];
    if (status == 0) start_ports(&state, v);
    for (long sample = 0; sample < samples; ++sample) {
        if (sample > 0 && status == 0) status = go_on(&state, sample - 1, &pace);
        if (status == 0) status = take_in(&state, sample, meant, &kept);
        if (status != 0) kept.least = kept.largest = kept.last = kept.squares = NAN;
        if (shown) shown[sample * sets + set] = kept.last;
        else if (status != 0) break;
    }
    summary[set] = kept.least;
    summary[sets + set] = kept.largest;
    summary[2 * sets + set] = kept.last;
    summary[3 * sets + set] = kept.squares;
}

#endif
