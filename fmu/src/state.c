/* Saved states: copies of an instance's memory, in the process or as bytes. */
#include "instance.h"

/* The first 8 bytes of a serialized state are zero, then come the marks it is known by. */
typedef struct {
    uint8_t zero[8];
    char magic[8];
    uint32_t version, size;
    uint64_t checksum;
    char token[48];
} Header;

static const char STATE_MAGIC[8] = {'P', 'A', 'M', 'S', 'T', 'A', 'T', 'E'};
static const char STATE_TOKEN[48] = MODEL_TOKEN; /* filled up with zeros */
enum { STATE_VERSION = 1 };

struct SavedState {
    Header header;
    Memory memory;
};

/* FNV-1a, 64 bit */
static uint64_t checksum(const void *data, size_t size) {
    const uint8_t *byte = data;
    uint64_t hash = 14695981039346656037u;
    for (size_t i = 0; i < size; i++) hash = (hash ^ byte[i]) * 1099511628211u;
    return hash;
}

/* Whether a state is one of this FMU; what lies behind the header is not looked at. */
static Status check_header(const Instance *s, const char *function, const Header *h) {
    static const uint8_t zero[8] = {0};
    if (memcmp(h->zero, zero, sizeof zero) != 0 ||
        memcmp(h->magic, STATE_MAGIC, sizeof STATE_MAGIC) != 0)
        return report(s, ERROR, function, "this is no saved state");
    if (h->version != STATE_VERSION)
        return report(s, ERROR, function, "the state has version %u, this FMU reads version %d",
                      (unsigned)h->version, STATE_VERSION);
    if (h->size != sizeof(Memory) || memcmp(h->token, STATE_TOKEN, sizeof STATE_TOKEN) != 0)
        return report(s, ERROR, function, "the state belongs to another FMU");
    return OK;
}

static Status check_state(const Instance *s, const char *function, const SavedState *state) {
    if (check_mode(s, function, ANY_MODE) != OK) return ERROR;
    if (state == NULL) return report(s, ERROR, function, "no state is given");
    return check_header(s, function, &state->header);
}

/* What no instance of this FMU can have in its memory; NULL when all is as it may be. */
static const char *impossible(const Memory *m) {
    const int simulated = m->kind == CO_SIMULATION;
    const int modes = INSTANTIATED | INITIALIZATION | TERMINATED | EVENT |
                      (simulated ? STEP : CONTINUOUS);
    if (!simulated && m->kind != MODEL_EXCHANGE) return "its kind";
    if (m->mode <= 0 || (m->mode & (m->mode - 1)) != 0 || (m->mode & modes) == 0) return "its mode";
    if (!isfinite(m->time) || isnan(m->stop_time) || m->stop_time == -INFINITY) return "its time";
    if (!(m->tolerance > 0.0 && m->tolerance <= MODEL_TOLERANCE)) return "its tolerance";
    if (!(m->step >= 0.0 && isfinite(m->step))) return "its step length";
    if (!all_finite(m->x, NX)) return "a state";
    for (int i = 0; i < NU; i++)
        if (!isfinite(m->u[i]) && !(isnan(m->u[i]) && MAY_BE_MISSING(i))) return "an input";
    for (int i = 0; i < NP; i++)
        if (!isfinite(m->p[i]) || m->p[i] < BOUND(P_MIN[i]) || m->p[i] > BOUND(P_MAX[i]))
            return "a parameter";
    if (!all_finite(m->slope, NU) || !all_finite(m->last_slope, NU)) return "a slope of an input";
    for (int i = 0; !simulated && i < NU; i++)
        if (m->slope[i] != 0.0 || m->last_slope[i] != 0.0) return "a slope of an input";
#ifdef MODEL_SAMPLED
    return impossible_samples(m);
#else
    return NULL;
#endif
}

static Status get_state(Instance *s, const char *function, SavedState **state) {
    if (check_mode(s, function, ANY_MODE) != OK) return ERROR;
    if (state == NULL) return report(s, ERROR, function, "the place for the state is missing");
    if (*state != NULL && check_header(s, function, &(*state)->header) != OK) return ERROR;
    if (*state == NULL) *state = calloc(1, sizeof **state);
    if (*state == NULL) return report(s, ERROR, function, "out of memory");
    Header *h = &(*state)->header;
    memcpy(h->magic, STATE_MAGIC, sizeof h->magic);
    h->version = STATE_VERSION;
    h->size = (uint32_t)sizeof(Memory);
    memcpy(h->token, STATE_TOKEN, sizeof h->token);
    memcpy(&(*state)->memory, &s->memory, sizeof(Memory));
    return OK;
}

static Status set_state(Instance *s, const char *function, const SavedState *state) {
    if (check_state(s, function, state) != OK) return ERROR;
    if (state->memory.kind != s->memory.kind)
        return report(s, ERROR, function, "the state is one of %s",
                      s->memory.kind == CO_SIMULATION ? "Model Exchange" : "Co-Simulation");
    if (state->memory.mode == EVENT && check_events(s, function, ANY_MODE) != OK) return ERROR;
    memcpy(&s->memory, &state->memory, sizeof(Memory));
    invalidate(s);
    return OK;
}

static Status free_state(Instance *s, const char *function, SavedState **state) {
    if (state == NULL || *state == NULL) return s == NULL ? ERROR : OK;
    if (check_state(s, function, *state) != OK) return ERROR;
    memset((*state)->header.magic, 0, sizeof STATE_MAGIC);
    free(*state);
    *state = NULL;
    return OK;
}

static Status serialized_size(Instance *s, const char *function, const SavedState *state,
                              size_t *size) {
    if (check_state(s, function, state) != OK) return ERROR;
    return get_count(s, function, sizeof *state, size);
}

static Status serialize(Instance *s, const char *function, const SavedState *state, uint8_t *bytes,
                        size_t size) {
    if (check_state(s, function, state) != OK) return ERROR;
    if (bytes == NULL || size < sizeof *state)
        return report(s, ERROR, function, "%zu bytes are given, %zu are needed", size,
                      sizeof *state);
    Header header = state->header;
    header.checksum = checksum(&state->memory, sizeof(Memory));
    memcpy(bytes, &header, sizeof header);
    memcpy(bytes + sizeof header, &state->memory, sizeof(Memory));
    return OK;
}

static Status check_bytes(const Instance *s, const char *function, const uint8_t *bytes,
                          size_t size) {
    Header h;
    Memory memory;
    if (bytes == NULL || size < sizeof(SavedState))
        return report(s, ERROR, function, "%zu bytes are given, a state has %zu", size,
                      sizeof(SavedState));
    memcpy(&h, bytes, sizeof h);
    if (check_header(s, function, &h) != OK) return ERROR;
    if (h.checksum != checksum(bytes + sizeof h, sizeof(Memory)))
        return report(s, ERROR, function, "the state is damaged: its checksum is wrong");
    memcpy(&memory, bytes + offsetof(SavedState, memory), sizeof memory);
    const char *wrong = impossible(&memory);
    if (wrong != NULL)
        return report(s, ERROR, function, "no instance can be in this state: %s", wrong);
    return OK;
}

static Status deserialize(Instance *s, const char *function, const uint8_t *bytes, size_t size,
                          SavedState **state) {
    if (check_mode(s, function, ANY_MODE) != OK) return ERROR;
    if (state == NULL) return report(s, ERROR, function, "the place for the state is missing");
    if (*state != NULL && check_header(s, function, &(*state)->header) != OK) return ERROR;
    if (check_bytes(s, function, bytes, size) != OK) return ERROR;
    if (*state == NULL) *state = calloc(1, sizeof **state);
    if (*state == NULL) return report(s, ERROR, function, "out of memory");
    memcpy(*state, bytes, sizeof **state);
    return OK;
}
