#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* psa_state without gaps: otherwise its bytes would depend on the platform. Does not compile if there are. */
#define WORDS_OF_POINT \
    ((14 + 3 * PSA_NX + PSA_NU + 1) + (1 + 2 * (PSA_NU + 1)) + (PSA_HELD + 1)) /* solver, input, parameters */
typedef char psa_state_has_no_gaps
    [sizeof(psa_state) == 8 * (2 * WORDS_OF_POINT + 2 + (PSA_NU + 1) + (PSA_NZ + 1) + (PSA_NS + 1) + 8 +
                                2 + 2 * (PSA_NU + 1) + 5 + (PSA_NX + 1))
         ? 1
         : -1];

/* Raise it whenever psa_state or psa_solver changes its meaning. */
#define SNAPSHOT_VERSION 7u

/* In front of the bytes of a psa_state: who wrote them, and whether they arrived whole. A machine of
   another byte order or struct layout fails the comparison of version or size. */
typedef struct {
    char magic[8];
    uint32_t version, size;
    uint64_t model; /* hash of the model's token */
    uint64_t checksum;
} psa_stamp;

/* What an importer holds. Some (fmusim) free a snapshot by itself where its address is asked for: then
   the zero is taken for the snapshot, which is missing, and nothing is freed. */
typedef struct {
    uint64_t zero;
    psa_state state;
} psa_snapshot;

/* FNV-1a, 64 bit */
static uint64_t hash(const void *data, size_t size) {
    const unsigned char *const bytes = data;
    uint64_t value = UINT64_C(14695981039346656037);
    for (size_t i = 0; i < size; ++i) value = (value ^ bytes[i]) * UINT64_C(1099511628211);
    return value;
}

static psa_stamp stamp_of(const void *state) {
    psa_stamp stamp = {"psasnap", SNAPSHOT_VERSION, (uint32_t)sizeof(psa_state), 0, 0};
    stamp.model = hash(psa_token, strlen(psa_token));
    stamp.checksum = hash(state, sizeof(psa_state));
    return stamp;
}

static psa_result provide(psa_instance *instance, void **snapshot) {
    if (!*snapshot) *snapshot = calloc(1, sizeof(psa_snapshot));
    if (*snapshot) {
        ((psa_snapshot *)*snapshot)->zero = 0;
        return PSA_FINE;
    }
    return psa_say(instance, PSA_ERROR, "There is no memory for a snapshot of %lu bytes.",
                   (unsigned long)sizeof(psa_snapshot));
}

psa_result psa_snapshot_take(psa_instance *instance, void **snapshot) {
    if (psa_lacks(instance, 1, snapshot, snapshot)) return PSA_ERROR;
    const psa_result result = provide(instance, snapshot);
    if (result == PSA_FINE) ((psa_snapshot *)*snapshot)->state = instance->state;
    return result;
}

psa_result psa_snapshot_restore(psa_instance *instance, const void *snapshot) {
    const psa_snapshot *const found = snapshot;
    if (psa_lacks(instance, 1, snapshot, snapshot)) return PSA_ERROR;
    if (found->state.interface != instance->state.interface)
        return psa_say(instance, PSA_ERROR,
                       "The snapshot is one of the other interface (co-simulation or model exchange).");
    instance->state = found->state;
    instance->fresh = 0;
    return PSA_FINE;
}

void psa_snapshot_release(void **snapshot) {
    if (!snapshot || !*snapshot) return;
    free(*snapshot);
    *snapshot = NULL;
}

size_t psa_snapshot_size(void) { return sizeof(psa_stamp) + sizeof(psa_state); }

psa_result psa_snapshot_write(psa_instance *instance, const void *snapshot, void *bytes, size_t size) {
    if (psa_lacks(instance, 1, snapshot, bytes)) return PSA_ERROR;
    if (size < psa_snapshot_size())
        return psa_say(instance, PSA_ERROR, "A snapshot needs %lu bytes; there are %lu.",
                       (unsigned long)psa_snapshot_size(), (unsigned long)size);
    const psa_state *const state = &((const psa_snapshot *)snapshot)->state;
    const psa_stamp stamp = stamp_of(state);
    memcpy(bytes, &stamp, sizeof stamp);
    memcpy((char *)bytes + sizeof stamp, state, sizeof *state);
    return PSA_FINE;
}

psa_result psa_snapshot_read(psa_instance *instance, const void *bytes, size_t size, void **snapshot) {
    psa_stamp found;
    void *read = NULL;
    if (psa_lacks(instance, 1, bytes, snapshot)) return PSA_ERROR;
    if (size != psa_snapshot_size())
        return psa_say(instance, PSA_ERROR, "These %lu bytes are no snapshot of this model, which has %lu.",
                       (unsigned long)size, (unsigned long)psa_snapshot_size());
    memcpy(&found, bytes, sizeof found);
    const psa_stamp expected = stamp_of((const char *)bytes + sizeof found);
    if (memcmp(found.magic, expected.magic, sizeof found.magic) || found.version != expected.version ||
        found.size != expected.size || found.model != expected.model)
        return psa_say(instance, PSA_ERROR,
                       "The snapshot was written by another model, version or kind of machine.");
    if (found.checksum != expected.checksum)
        return psa_say(instance, PSA_ERROR, "The snapshot is damaged: its checksum does not match.");
    psa_result result = provide(instance, &read);
    if (result != PSA_FINE) return result;
    psa_state *const state = &((psa_snapshot *)read)->state;
    memcpy(state, (const char *)bytes + sizeof found, sizeof *state);
    const char *const fault = psa_state_fault(state);
    if (fault)
        result = psa_say(instance, PSA_ERROR,
                         "The snapshot was altered: %s cannot be what this model wrote.", fault);
    else if ((result = provide(instance, snapshot)) == PSA_FINE)
        ((psa_snapshot *)*snapshot)->state = *state;
    psa_snapshot_release(&read);
    return result;
}
