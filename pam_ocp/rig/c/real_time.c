/* The loop of a controller on a real rig: absolute deadlines, the lines of drivers/lines.py, the
   guard of guard.py. Linux; no heap. law.h and law.c are what export_c writes of the controller.

   All that it is told and all that it tells stands in memory that it shares with Python
   (real_time.py, class Shared, has the same fields); rows go through a ring. At each deadline the
   newest answer is looked at, the controller's step is taken, and commands are sent; their answer is
   that of the next deadline.

   Where two processors are given, a thread waits on each, and whichever wakes first takes the sample:
   a processor that is taken away for some milliseconds (by a hypervisor, an interrupt, the kernel)
   costs a deadline only where it happens in the midst of a sample, or to both at once. */
#define _GNU_SOURCE
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include "law.c"

#define SHOWN __attribute__((visibility("default")))
#define MOST 32         /* readings, commands, inputs of the law that are told */
#define INPUTS 256      /* of the law */
#define BINS 80         /* of a histogram: ten a decade from 1 microsecond on */
#define LONGEST 1024    /* bytes of a line */
#define AHEAD 4         /* lines without an answer, after which only each fourth sample sends one */
#define PATIENCE 0.25   /* how long it goes on venting where nothing answers [s] */
#define PAUSE 5         /* between two such lines [ms] */

enum { ENDED, STOPPED, LATE, OLD, NO_NUMBER, OUTSIDE, FAST, FROZEN, ASTRAY, NO_COMMAND, ALONE, NO_DOG };

typedef struct { /* a reading: SI = gain raw + zero */
    double gain, zero, low, high, rate, frozen, filter, deviation, within;
    int64_t follows, slope_of; /* a command, a reading; -1 for none */
    double last, at, since, astray, slope;
    int64_t known, away; /* whether last and since, or astray, are of meaning */
} reading;

typedef struct {
    double gain, zero, low, high, rate, begin, sent, offset;
} command;

typedef struct {
    int64_t source, index; /* 0 start value, 1 reading, 2 command sent, 3 column of the table */
} input;

typedef struct {
    int64_t fd, datagrams, dog, parent, priority, cpu, standby;
    int64_t readings, commands, columns, rows, capacity, steps, bumpless;
    double period, max_age, late, tolerated, fade, beat;
    reading reading[MOST];
    command command[MOST];
    input input[INPUTS];
    int64_t output[MOST]; /* which output of the law a command is */
    int64_t sequence;
    double zero; /* the first deadline [s] */
    double values[MOST], stamp;
    /* told */
    _Atomic int64_t go, stop, ready, over, head;
    int64_t scheduler, locked; /* errno of each, 0 where it was allowed */
    int64_t samples, missed, answers, unfit, silent, cause, place, vented;
    double figure, reaction, oldest, latest, longest;
    int64_t lateness[BINS], busy[BINS];
} shared;

typedef struct {
    shared *s;
    double *ring;
    const double *table;
    double offset, heard;
    int64_t clocked, unanswered;
    char rest[LONGEST];
    size_t held;
    double beaten;
    _Atomic int64_t next; /* the sample that is due */
    _Atomic int over;
    atomic_flag taken; /* whoever has set it may touch all but these three */
} loop;

static law_state state;
static law_parameters parameters;
static law_inputs inputs;
static law_outputs outputs;

/* ---- time ------------------------------------------------------------------------------------ */
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void wait_until(double when) {
    struct timespec t;
    t.tv_sec = (time_t)when;
    t.tv_nsec = (long)(1e9 * (when - (double)t.tv_sec));
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, 0) == EINTR) {
    }
}

static void count(int64_t *bins, double seconds) {
    const double micro = 1e6 * seconds;
    int bin = micro > 1 ? 1 + (int)(10 * log10(micro)) : 0;
    ++bins[bin < BINS ? bin : BINS - 1];
}

/* ---- lines ----------------------------------------------------------------------------------- */
SHOWN uint32_t pam_crc(const char *text, size_t length) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < length; ++i) {
        crc ^= (unsigned char)text[i];
        for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ (0xEDB88320u & (0u - (crc & 1u)));
    }
    return ~crc;
}

/* A line with sequence, code and, behind W, the commands as raw numbers. */
static void say(loop *l, char code) {
    shared *s = l->s;
    char line[LONGEST];
    s->sequence = (s->sequence + 1) & 0xFFFFFFFF;
    int n = snprintf(line, sizeof line, ">%lld %c", (long long)s->sequence, code);
    for (int i = 0; code == 'W' && i < s->commands; ++i) {
        const command *c = &s->command[i];
        n += snprintf(line + n, sizeof line - (size_t)n, " %.17g", (c->sent - c->zero) / c->gain);
        if (n > LONGEST - 16) return; /* longer than a line may be: no channel is left out */
    }
    n += snprintf(line + n, sizeof line - (size_t)n, "*%08X\n", (unsigned)pam_crc(line, (size_t)n));
    ++l->unanswered;
    const ssize_t done = write((int)s->fd, line, (size_t)n);
    (void)done; /* what is lost stays without an answer */
}

/* The stamp of an answer on this host's clock: DeviceClock of driver.py. */
static double stamped(loop *l, double device, double received) {
    const double ahead = received - device, drift = 1e-3;
    if (!l->clocked || ahead < l->offset + drift * (received - l->heard)) l->offset = ahead;
    else l->offset += drift * (received - l->heard);
    l->clocked = 1;
    l->heard = received;
    return device + l->offset;
}

/* Whether a line (without its line feed) answers a question newer than the last that was answered;
   its readings are taken over in SI with their stamp. */
static int taken(loop *l, char *line, size_t n, double received) {
    shared *s = l->s;
    double found[MOST];
    char *at = line + 1, *end;
    if (n < 11 || line[0] != '<' || line[n - 9] != '*') return 0;
    if (strtoul(line + n - 8, &end, 16) != pam_crc(line, n - 9) || end != line + n) return 0;
    line[n - 9] = 0;
    const int64_t sequence = strtoll(at, &end, 10);
    if (end == at) return 0;
    const double device = 1e-6 * strtod(at = end, &end);
    if (end == at) return 0;
    for (int i = 0; i < s->readings; ++i) {
        if (s->reading[i].slope_of >= 0) continue;
        const double raw = strtod(at = end, &end);
        if (end == at) return 0;
        found[i] = s->reading[i].gain * raw + s->reading[i].zero;
    }
    if (*end) return 0;
    if (((s->sequence - sequence) & 0xFFFFFFFF) >= l->unanswered) return 0; /* of long ago, or seen */
    const double stamp = stamped(l, device, received);
    l->unanswered = (s->sequence - sequence) & 0xFFFFFFFF;
    ++s->answers;
    if (stamp < s->stamp) return 1;
    for (int i = 0; i < s->readings; ++i)
        if (s->reading[i].slope_of < 0) s->values[i] = found[i];
    s->stamp = stamp;
    return 1;
}

/* All that has come; whether a fitting answer was among it. */
static int hear(loop *l) {
    int good = 0;
    for (;;) {
        const ssize_t n = read((int)l->s->fd, l->rest + l->held, LONGEST - l->held);
        if (n <= 0) return good;
        size_t begin = 0, all = l->held + (size_t)n;
        const double received = now();
        for (size_t i = 0; i < all; ++i) {
            if (l->rest[i] != '\n') continue;
            size_t length = i - begin;
            if (length && l->rest[i - 1] == '\r') --length;
            if (taken(l, l->rest + begin, length, received)) good = 1;
            else if (length) ++l->s->unfit;
            begin = i + 1;
        }
        l->held = l->s->datagrams || all - begin == LONGEST ? 0 : all - begin; /* or it is noise */
        memmove(l->rest, l->rest + begin, l->held);
    }
}

/* ---- the guard: as Watch in guard.py --------------------------------------------------------- */
static int fault(shared *s, int64_t cause, int64_t place, double figure) {
    s->cause = cause, s->place = place, s->figure = figure;
    return (int)cause;
}

static int look_at(shared *s, int i, double time) {
    reading *r = &s->reading[i];
    const double value = s->values[i], away = fabs(value - r->last);
    if (!isfinite(value)) return fault(s, NO_NUMBER, i, value);
    if (!(r->low <= value && value <= r->high)) return fault(s, OUTSIDE, i, value);
    if (r->known && s->stamp > r->at && away > r->rate * (s->stamp - r->at))
        return fault(s, FAST, i, away / (s->stamp - r->at));
    if (!r->known || value != r->last) r->since = time;
    if (!r->known || s->stamp > r->at) r->last = value, r->at = s->stamp;
    r->known = 1;
    if (time - r->since > r->frozen) return fault(s, FROZEN, i, time - r->since);
    if (r->follows < 0) return 0;
    if (fabs(value - s->command[r->follows].sent) <= r->deviation) {
        r->away = 0;
    } else {
        if (!r->away) r->astray = time;
        r->away = 1;
        if (time - r->astray > r->within)
            return fault(s, ASTRAY, i, fabs(value - s->command[r->follows].sent));
    }
    return 0;
}

/* What is wrong with the newest readings, 0 where nothing is. A stamp is never ahead of the clock:
   stamped() takes the smallest delay that was seen. */
SHOWN int pam_look(shared *s, double time) {
    const double age = time - s->stamp;
    if (!(age <= s->max_age)) return fault(s, OLD, -1, age);
    for (int i = 0; i < s->readings; ++i) {
        const int cause = look_at(s, i, time);
        if (cause) return cause;
    }
    return 0;
}

/* What is asked for, within ranges and rates. */
SHOWN int pam_limit(shared *s, const double *asked) {
    for (int i = 0; i < s->commands; ++i) {
        command *c = &s->command[i];
        const double way = c->rate * s->period;
        if (!isfinite(asked[i])) return fault(s, NO_COMMAND, i, asked[i]);
        c->sent = fmin(fmax(fmin(fmax(asked[i], c->sent - way), c->sent + way), c->low), c->high);
    }
    return 0;
}

/* ---- one sample ------------------------------------------------------------------------------ */
static void slopes(shared *s, double before) {
    for (int i = 0; i < s->readings; ++i) {
        reading *r = &s->reading[i];
        if (r->slope_of < 0) continue;
        const double span = s->stamp - before, value = s->values[r->slope_of];
        if (span > 0) {
            const double share = exp(-span / r->filter);
            s->values[i] = share * s->values[i] + (1 - share) * (value - r->slope) / span;
        }
        r->slope = value; /* of the sample before */
    }
}

static int control(loop *l, int64_t k) {
    shared *s = l->s;
    law_real *u = (law_real *)(void *)&inputs;
    const law_real *y = (const law_real *)(const void *)&outputs;
    const int64_t row = k < s->rows ? k : s->rows - 1;
    double asked[MOST];
    for (int i = 0; i < (int)(sizeof inputs / sizeof(law_real)) && i < INPUTS; ++i) {
        const int64_t from = s->input[i].index;
        if (s->input[i].source == 1) u[i] = s->values[from];
        else if (s->input[i].source == 2) u[i] = s->command[from].sent;
        else if (s->input[i].source == 3) u[i] = l->table[row * s->columns + from];
    }
    law_step(&state, &parameters, &inputs, &outputs);
    const double left = s->bumpless && s->fade > 0 ? exp(-(double)k * s->period / s->fade) : 0;
    for (int i = 0; i < s->commands; ++i) {
        asked[i] = y[s->output[i]];
        if (k == 0) s->command[i].offset = s->command[i].begin - asked[i];
        if (left > 0) asked[i] += left * s->command[i].offset;
    }
    return pam_limit(s, asked);
}

static int beat(loop *l, double time, char letter) {
    shared *s = l->s;
    if (s->dog < 0 || (letter == 'H' && time - l->beaten < s->beat)) return 1;
    l->beaten = time;
    return write((int)s->dog, &letter, 1) == 1 || errno == EAGAIN;
}

static void tell(loop *l, double deadline, double woken) {
    shared *s = l->s;
    const int64_t width = 4 + s->readings + s->commands, head = s->head;
    double *row = l->ring + (head % s->capacity) * width;
    *row++ = deadline, *row++ = woken, *row++ = s->stamp, *row++ = now();
    for (int i = 0; i < s->readings; ++i) *row++ = s->values[i];
    for (int i = 0; i < s->commands; ++i) *row++ = s->command[i].sent;
    atomic_store_explicit(&s->head, head + 1, memory_order_release);
}

static int sample(loop *l, int64_t k, double deadline) {
    shared *s = l->s;
    const double woken = now(), before = s->stamp;
    count(s->lateness, fmax(woken - deadline, 0));
    ++s->samples;
    const int late = woken - deadline > s->tolerated * s->period;
    s->missed += late;
    if (!hear(l)) ++s->silent;
    s->oldest = fmax(s->oldest, woken - s->stamp);
    s->latest = fmax(s->latest, woken - deadline);
    if (s->stamp > before) slopes(s, before);
    if (atomic_load(&s->stop)) return fault(s, STOPPED, -1, 0);
    if (getppid() != (pid_t)s->parent) return fault(s, ALONE, -1, 0);
    if (woken - deadline > s->late) return fault(s, LATE, -1, woken - deadline);
    if (pam_look(s, woken) || control(l, k)) return (int)s->cause;
    if (l->unanswered < AHEAD || k % AHEAD == 0) say(l, 'W');
    if (!beat(l, woken, 'H')) return fault(s, NO_DOG, -1, 0);
    tell(l, deadline, woken);
    const double busy = now() - woken;
    if (!late && woken + busy - deadline > s->period) ++s->missed; /* begun in time, ended too late */
    s->longest = fmax(s->longest, busy);
    count(s->busy, busy);
    return 0;
}

/* Let the air out, again and again until it is answered. */
static void vent(loop *l, double noticed) {
    shared *s = l->s;
    const double until = noticed + PATIENCE;
    struct pollfd ready = {(int)s->fd, POLLIN, 0};
    l->unanswered = 0; /* answers to V alone count */
    say(l, 'V');
    s->reaction = now() - noticed;
    if (s->cause != ENDED && s->cause != STOPPED) beat(l, noticed, 'V');
    while (now() < until) {
        poll(&ready, 1, PAUSE);
        if (hear(l)) {
            s->vented = 1;
            break;
        }
        say(l, 'V');
    }
    if (s->vented && (s->cause == ENDED || s->cause == STOPPED)) beat(l, noticed, 'I');
    else beat(l, noticed, 'V');
}

static void stay_on(int64_t cpu) {
    cpu_set_t set;
    if (cpu < 0) return;
    CPU_ZERO(&set);
    CPU_SET((size_t)cpu, &set);
    sched_setaffinity(0, sizeof set, &set);
}

static void prepare(shared *s) {
    struct sched_param own = {.sched_priority = (int)s->priority};
    prctl(PR_SET_TIMERSLACK, 1UL);
    s->locked = mlockall(MCL_CURRENT | MCL_FUTURE) ? errno : 0;
    s->scheduler = s->priority && sched_setscheduler(0, SCHED_FIFO, &own) ? errno : 0;
    stay_on(s->cpu);
    law_init(&state, &parameters, &inputs);
}

/* Sample after sample, unless the other thread is at it. */
static void turns(loop *l) {
    shared *s = l->s;
    while (!atomic_load(&l->over)) {
        const int64_t k = atomic_load(&l->next);
        wait_until(s->zero + (double)k * s->period);
        if (atomic_flag_test_and_set_explicit(&l->taken, memory_order_acquire)) {
            wait_until(fmax(s->zero + (double)(k + 1) * s->period, now() + s->period / 4));
            continue;
        }
        if (!atomic_load(&l->over) && atomic_load(&l->next) == k) {
            const double noticed = now();
            if (k == s->steps || sample(l, k, s->zero + (double)k * s->period)) {
                vent(l, noticed);
                atomic_store(&l->over, 1);
            } else {
                atomic_store(&l->next, k + 1);
            }
        }
        atomic_flag_clear_explicit(&l->taken, memory_order_release);
    }
}

static void *stand_by(void *given) {
    loop *l = given;
    prctl(PR_SET_TIMERSLACK, 1UL);
    stay_on(l->s->standby);
    turns(l);
    return NULL;
}

/* Behind the header stand the table (rows x columns) and the ring (capacity rows). */
SHOWN int pam_real_time(shared *s) {
    static loop l;
    pthread_t other;
    memset(&l, 0, sizeof l);
    atomic_flag_clear(&l.taken);
    l.s = s;
    double *table = (double *)(void *)(s + 1);
    l.table = table;
    l.ring = table + s->rows * s->columns;
    prepare(s);
    atomic_store(&s->ready, 1);
    while (!atomic_load(&s->go)) {
        if (atomic_load(&s->stop) || getppid() != (pid_t)s->parent) return 0;
        wait_until(now() + 2e-4);
    }
    for (int i = 0; i < s->readings; ++i)
        if (s->reading[i].slope_of >= 0) s->reading[i].slope = s->values[s->reading[i].slope_of];
    s->zero = now();
    hear(&l); /* nothing of before counts */
    const int two = s->standby >= 0 && !pthread_create(&other, NULL, stand_by, &l);
    if (!two) s->standby = -1;
    turns(&l);
    if (two) pthread_join(other, NULL);
    atomic_store(&s->over, 1);
    return (int)s->cause;
}

SHOWN size_t pam_size(void) { return sizeof(shared); }
