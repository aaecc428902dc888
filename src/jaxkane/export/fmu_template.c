// head
/* $title

   One translation unit without other files: the equations of the system, a method of integration for co-simulation,
   and the functions of the interface FMI $fmi. */

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TOKEN "$token"
#define STEP $step /* longest internal step of co-simulation [s] */
#define SIZE(n) ((n) > 0 ? (n) : 1) /* C99 has no arrays of length zero */

enum {
    N_P = $parameters,  /* parameters */
    N_W = $inputs,      /* inputs */
    N_Y = $states,      /* continuous states: coordinates, independent speeds, first-order states */
    N_S = $sensed,      /* dependent speeds and outputs */
    N_E = $events,      /* event functions */
    N_C = $conditions,  /* conditions of events */
    N_H = $constraints, /* configuration constraints */
    N_M = $moved,       /* coordinates for which they are solved */
    SINGULAR = $singular /* the event at which the dependent speeds are singular, or -1 */
};

/* Value references: the time, parameters, inputs, states, their rates, sensed quantities, event functions. */
enum { P0 = 1, W0 = P0 + N_P, Y0 = W0 + N_W, D0 = Y0 + N_Y, S0 = D0 + N_Y, E0 = S0 + N_S, END = E0 + N_E };

// state
enum { OK, WARNING, DISCARD, ERROR };
enum { CREATED, INITIALIZING, EVENT_MODE, CONTINUOUS, STEPPING, TERMINATED };

/* All that changes. It has no pointers, so a copy of its bytes restores it. */
typedef struct {
    double t, p[SIZE(N_P)], w[SIZE(N_W)], y[SIZE(N_Y)];
    int side[SIZE(N_E)];     /* side of zero from which each event function comes: 1 or -1 */
    double slack[SIZE(N_E)]; /* how far beyond zero a function may be before it counts as crossed */
    int mode;
    int ended_by;         /* the event that ended the simulation, or -1 */
    double first_jump;    /* start of the time span in which jumps are counted [s] */
    int n_jumps;          /* number of jumps in this time span */
} model_state;

typedef void (*function_type)(void);

typedef struct {
    model_state now;
    bool co_simulation, returns_early;
    char *name;
    void *environment;
    function_type log;
} instance;

/* Passes a message to the importer; defined by each version of the interface. */
static void send(const instance *m, int status, const char *text);

static void report(instance *m, int status, const char *format, ...) {
    char text[512];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    if (m->log) send(m, status, text);
}

static bool is_finite(const double *x, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (!isfinite(x[i])) return false;
    return true;
}

static void set_defaults(instance *m) {
    memset(&m->now, 0, sizeof m->now);
    memcpy(m->now.p, default_p, N_P * sizeof(double));
    memcpy(m->now.y, default_y, N_Y * sizeof(double));
    m->now.mode = CREATED;
    m->now.ended_by = -1;
}

static instance *create(const char *name, const char *token, bool co_simulation, void *environment, function_type log) {
    instance *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->environment = environment;
    m->log = log;
    m->co_simulation = co_simulation;
    m->name = calloc(strlen(name ? name : "") + 1, 1);
    if (!m->name || !token || strcmp(token, TOKEN) != 0) {
        if (m->name) report(m, ERROR, "The model description belongs to another version of this FMU. Export it again.");
        free(m->name);
        free(m);
        return NULL;
    }
    strcpy(m->name, name ? name : "");
    set_defaults(m);
    return m;
}

static void destroy(instance *m) {
    if (m) free(m->name);
    free(m);
}

/* ---- Configuration constraints ---- */

/* Solves A x = b (n, n) for symmetric A >= 0 by elimination with diagonal pivots. Redundant rows are omitted. */
static void solve_symmetric(int n, double *A, double *b) {
    int order[SIZE(N_H)], done[SIZE(N_H)] = {0}, rank = 0, i, j, k;
    double largest = 0.0;
    for (i = 0; i < n; i++) largest = fmax(largest, A[i * n + i]);
    while (rank < n) {
        int pivot = -1;
        for (i = 0; i < n; i++)
            if (!done[i] && (pivot < 0 || A[i * n + i] > A[pivot * n + pivot])) pivot = i;
        if (!(A[pivot * n + pivot] > 1e-13 * largest)) break;
        done[pivot] = 1;
        order[rank++] = pivot;
        for (i = 0; i < n; i++) {
            const double factor = done[i] ? 0.0 : A[i * n + pivot] / A[pivot * n + pivot];
            if (done[i]) continue;
            for (j = 0; j < n; j++)
                if (!done[j]) A[i * n + j] -= factor * A[pivot * n + j];
            b[i] -= factor * b[pivot];
        }
    }
    for (i = 0; i < n; i++)
        if (!done[i]) b[i] = 0.0;
    for (k = rank - 1; k >= 0; k--) {
        const int row = order[k];
        for (j = k + 1; j < rank; j++) b[row] -= A[row * n + order[j]] * b[order[j]];
        b[row] /= A[row * n + row];
    }
}

/* The smallest change (N_M) of the coordinates that removes the residuals to first order. Returns its largest entry
   relative to 1 + |q|. */
static double correction(const model_state *s, double t, const double *y, double *change) {
    double h[SIZE(N_H)], G[SIZE(N_H * N_M)], A[SIZE(N_H * N_H)], size = 0.0;
    int i, j, k;
    configuration_of(t, y, s->w, s->p, h, G);
    for (i = 0; i < N_H; i++)
        for (j = 0; j < N_H; j++) {
            A[i * N_H + j] = 0.0;
            for (k = 0; k < N_M; k++) A[i * N_H + j] += G[i * N_M + k] * G[j * N_M + k];
        }
    solve_symmetric(N_H, A, h);
    for (k = 0; k < N_M; k++) {
        change[k] = 0.0;
        for (i = 0; i < N_H; i++) change[k] -= G[i * N_M + k] * h[i];
        size = change[k] == change[k] ? fmax(size, fabs(change[k]) / (1.0 + fabs(y[moved[k]]))) : INFINITY;
    }
    return size;
}

/* Solves the configuration constraints by Newton's method, from the start values. */
static int assemble(instance *m) {
    double change[SIZE(N_M)], h[SIZE(N_H)], G[SIZE(N_H * N_M)];
    int step, k, i;
    if (N_H == 0) return OK;
    for (step = 0; step < 100; step++) {
        if (correction(&m->now, m->now.t, m->now.y, change) < 1e-13) {
            configuration_of(m->now.t, m->now.y, m->now.w, m->now.p, h, G);
            for (i = 0; i < N_H && fabs(h[i]) < 1e-6; i++) {} /* a residual that no coordinate changes */
            if (i == N_H) return OK;
            break;
        }
        for (k = 0; k < N_M; k++) m->now.y[moved[k]] += change[k];
    }
    report(m, ERROR, "The start values cannot be changed so that they satisfy the configuration constraints.");
    return ERROR;
}

// variables
/* ---- Modes and variables ---- */

static int enter_mode(instance *m, int mode, bool is_allowed) {
    if (!is_allowed) report(m, ERROR, "This function must not be called now.");
    else m->now.mode = mode;
    return is_allowed ? OK : ERROR;
}

static int start(instance *m, double t) {
    if (!isfinite(t)) {
        report(m, ERROR, "The start time %g is not finite.", t);
        return ERROR;
    }
    m->now.t = t;
    return OK;
}

static int initialize(instance *m) {
    double rate[SIZE(N_Y)];
    bool changed;
    if (m->now.mode != INITIALIZING) return enter_mode(m, INITIALIZING, false);
    if (assemble(m) != OK) return ERROR;
    rate_of(m->now.t, m->now.y, m->now.w, m->now.p, rate);
    if (!is_finite(rate, N_Y)) {
        report(m, ERROR, "The rates of the states are not finite at the start values.");
        return ERROR;
    }
    set_sides(&m->now);
    m->now.mode = m->co_simulation ? STEPPING : EVENT_MODE;
    return m->co_simulation ? perform_events(m, -1, &changed) : OK;
}

/* Event functions with a hysteresis of a rounding error: a function that is zero after a jump has the sign of its
   side. */
static void indicators(const model_state *s, double *z) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    int j;
    if (N_E > 0) events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    for (j = 0; j < N_E; j++) {
        const double width = isfinite(g_dot[j]) ? fabs(g_dot[j]) * rounding(s->t) : 0.0;
        z[j] = g[j] + s->side[j] * (width + s->slack[j] + DBL_MIN);
    }
}

static int get_rates(instance *m, double *rate) {
    rate_of(m->now.t, m->now.y, m->now.w, m->now.p, rate);
    if (is_finite(rate, N_Y)) return OK;
    report(m, DISCARD, "t = %.17g: the rates of the states are not finite.", m->now.t);
    return DISCARD;
}

static int get_numbers(instance *m, const uint32_t *references, size_t n, double *values) {
    const model_state *s = &m->now;
    double rate[SIZE(N_Y)] = {0.0}, sensed[SIZE(N_S)] = {0.0}, z[SIZE(N_E)] = {0.0};
    bool has_rates = false, has_sensed = false, has_indicators = false;
    size_t i;
    if (m->now.mode == INITIALIZING && assemble(m) != OK) return ERROR;
    for (i = 0; i < n; i++) {
        const int64_t r = references[i];
        if (r >= END) {
            report(m, ERROR, "There is no variable with the value reference %u.", (unsigned)r);
            return ERROR;
        }
        if (r >= D0 && r < S0 && !has_rates) rate_of(s->t, s->y, s->w, s->p, rate);
        if (r >= S0 && r < E0 && !has_sensed) sensed_of(s->t, s->y, s->w, s->p, sensed);
        if (r >= E0 && !has_indicators) indicators(s, z);
        has_rates |= r >= D0 && r < S0;
        has_sensed |= r >= S0 && r < E0;
        has_indicators |= r >= E0;
        values[i] = r < P0 ? s->t : r < W0 ? s->p[r - P0] : r < Y0 ? s->w[r - W0] : r < D0 ? s->y[r - Y0]
                  : r < S0 ? rate[r - D0] : r < E0 ? sensed[r - S0] : z[r - E0];
    }
    return OK;
}

static int set_number(instance *m, int64_t r, double value) {
    const bool before_start = m->now.mode == CREATED || m->now.mode == INITIALIZING;
    if (r >= P0 && r < W0) {
        const int64_t i = r - P0;
        if (is_fixed[i] && !before_start) {
            report(m, ERROR, "The configuration constraints depend on the parameter '%s'. Set it before the end of the "
                   "initialization.", parameter_names[i]);
            return ERROR;
        }
        if (!(value >= lower[i] && value <= upper[i]) || (is_positive[i] && !(value > 0.0))) {
            report(m, ERROR, "The parameter '%s' = %g must be between %g and %g%s.", parameter_names[i], value,
                   lower[i], upper[i], is_positive[i] ? ", and positive" : "");
            return ERROR;
        }
        m->now.p[i] = value;
    } else if (r >= W0 && r < Y0) {
        m->now.w[r - W0] = value;
    } else if (r >= Y0 && r < D0 && before_start) {
        m->now.y[r - Y0] = value;
    } else {
        report(m, ERROR, "The variable with the value reference %u cannot be set now.", (unsigned)r);
        return ERROR;
    }
    return OK;
}

static int set_numbers(instance *m, const uint32_t *references, size_t n, const double *values) {
    int status = OK;
    size_t i;
    for (i = 0; i < n && status == OK; i++) status = set_number(m, references[i], values[i]);
    return status;
}

/* Derivatives of rates, sensed quantities and event functions along a direction of states, inputs, parameters, time. */
static int get_directional(instance *m, const uint32_t *unknowns, size_t n_unknowns, const uint32_t *knowns,
                           size_t n_knowns, const double *seed, double *values) {
    const model_state *s = &m->now;
    double dt = 0.0, dp[SIZE(N_P)] = {0.0}, dw[SIZE(N_W)] = {0.0}, dy[SIZE(N_Y)] = {0.0};
    double rate[SIZE(N_Y)] = {0.0}, sensed[SIZE(N_S)] = {0.0}, g[SIZE(N_E)] = {0.0};
    size_t i;
    for (i = 0; i < n_knowns; i++) {
        const int64_t r = knowns[i];
        double *place = r < P0 ? &dt : r < W0 ? &dp[r - P0] : r < Y0 ? &dw[r - W0] : r < D0 ? &dy[r - Y0] : NULL;
        if (!place) {
            report(m, ERROR, "Derivatives with respect to the value reference %u do not exist.", (unsigned)r);
            return ERROR;
        }
        *place += seed[i];
    }
    derivatives_of(s->t, s->y, s->w, s->p, dt, dy, dw, dp, rate, sensed, g);
    for (i = 0; i < n_unknowns; i++) {
        const int64_t r = unknowns[i];
        if (r < D0 || r >= END) {
            report(m, ERROR, "The value reference %u has no derivatives.", (unsigned)r);
            return ERROR;
        }
        values[i] = r < S0 ? rate[r - D0] : r < E0 ? sensed[r - S0] : g[r - E0];
    }
    return OK;
}

static int copy_state(instance *m, void **copy) {
    if (!*copy) *copy = malloc(sizeof(model_state));
    if (!*copy) {
        report(m, ERROR, "There is not enough memory for the state.");
        return ERROR;
    }
    memcpy(*copy, &m->now, sizeof(model_state));
    return OK;
}

static int restore_state(instance *m, const void *copy) {
    if (!copy) {
        report(m, ERROR, "There is no state to restore.");
        return ERROR;
    }
    memcpy(&m->now, copy, sizeof(model_state));
    return OK;
}

static int check_size(instance *m, size_t n, size_t expected) {
    if (n == expected) return OK;
    report(m, ERROR, "An array has %lu elements; it must have %lu.", (unsigned long)n, (unsigned long)expected);
    return ERROR;
}

/* For functions of the interface that this FMU does not offer, unless they are called for no variable. */
static int refuse(instance *m, size_t n) {
    if (n > 0) report(m, ERROR, "The model description does not offer this function or type of variables.");
    return n > 0 ? ERROR : OK;
}

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#define JOIN(a, b) a##b
#define PREFIXED(prefix, name) JOIN(prefix, name)
