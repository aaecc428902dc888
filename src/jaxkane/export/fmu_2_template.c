/* ---- The functions of FMI 2.0 ---- */

typedef unsigned int reference2;
typedef void (*logger2)(void *environment, const char *instance_name, int status, const char *category,
                            const char *message, ...);
typedef struct {
    logger2 logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, int);
    void *environment;
} callbacks2;
typedef struct {
    int needs_update, terminates, nominals_changed, values_changed, has_next_time;
    double next_time;
} event_info2;

static void send(const instance *m, int status, const char *text) {
    const char *category = status == DISCARD ? "logStatusDiscard" : "logStatusError";
    ((logger2)m->log)(m->environment, m->name, status, category, "%s", text);
}

#ifdef FMI2_FUNCTION_PREFIX /* for importers that link several FMUs statically */
#define FULL(name) PREFIXED(FMI2_FUNCTION_PREFIX, name)
#else
#define FULL(name) name
#endif
#define FUNCTION(name) EXPORT int FULL(name)

EXPORT const char *FULL(fmi2GetTypesPlatform)(void) { return "default"; }
EXPORT const char *FULL(fmi2GetVersion)(void) { return "2.0"; }

EXPORT void *FULL(fmi2Instantiate)(const char *name, int kind, const char *token, const char *resources,
                                   const callbacks2 *functions, int visible, int logging) {
    (void)resources, (void)visible, (void)logging;
    if (!functions) return create(name, token, kind == 1, NULL, NULL);
    return create(name, token, kind == 1, functions->environment, (function_type)functions->logger);
}
EXPORT void FULL(fmi2FreeInstance)(instance *m) { destroy(m); }

FUNCTION(fmi2SetDebugLogging)(instance *m, int on, size_t n, const char *const *categories) {
    (void)m, (void)on, (void)n, (void)categories;
    return OK;
}
FUNCTION(fmi2SetupExperiment)(instance *m, int has_tolerance, double tolerance, double t, int has_stop, double stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return m->now.mode == CREATED ? start(m, t) : enter_mode(m, CREATED, false);
}
FUNCTION(fmi2EnterInitializationMode)(instance *m) { return enter_mode(m, INITIALIZING, m->now.mode == CREATED); }
FUNCTION(fmi2ExitInitializationMode)(instance *m) { return initialize(m); }
FUNCTION(fmi2Terminate)(instance *m) { return enter_mode(m, TERMINATED, true); }
FUNCTION(fmi2Reset)(instance *m) {
    set_defaults(m);
    return OK;
}

FUNCTION(fmi2GetReal)(instance *m, const reference2 *r, size_t n, double *x) { return get_numbers(m, r, n, x); }
FUNCTION(fmi2SetReal)(instance *m, const reference2 *r, size_t n, const double *x) { return set_numbers(m, r, n, x); }
#define NO_VARIABLES(type, c_type) \
    FUNCTION(fmi2Get##type)(instance *m, const reference2 *r, size_t n, c_type *x) { \
        (void)r, (void)x; \
        return refuse(m, n); \
    } \
    FUNCTION(fmi2Set##type)(instance *m, const reference2 *r, size_t n, const c_type *x) { \
        (void)r, (void)x; \
        return refuse(m, n); \
    }
NO_VARIABLES(Integer, int)
NO_VARIABLES(Boolean, int)
NO_VARIABLES(String, char *)

FUNCTION(fmi2GetFMUstate)(instance *m, void **copy) { return copy_state(m, copy); }
FUNCTION(fmi2SetFMUstate)(instance *m, void *copy) { return restore_state(m, copy); }
FUNCTION(fmi2FreeFMUstate)(instance *m, void **copy) {
    (void)m;
    free(*copy);
    *copy = NULL;
    return OK;
}
FUNCTION(fmi2SerializedFMUstateSize)(instance *m, void *copy, size_t *size) {
    (void)m, (void)copy;
    *size = sizeof(model_state);
    return OK;
}
FUNCTION(fmi2SerializeFMUstate)(instance *m, void *copy, char *bytes, size_t size) {
    if (check_size(m, size, sizeof(model_state)) != OK) return ERROR;
    memcpy(bytes, copy, size);
    return OK;
}
FUNCTION(fmi2DeSerializeFMUstate)(instance *m, const char *bytes, size_t size, void **copy) {
    if (check_size(m, size, sizeof(model_state)) != OK || copy_state(m, copy) != OK) return ERROR;
    memcpy(*copy, bytes, size);
    return OK;
}
FUNCTION(fmi2GetDirectionalDerivative)(instance *m, const reference2 *unknowns, size_t n_unknowns,
                                       const reference2 *knowns, size_t n_knowns, const double *seed, double *values) {
    return get_directional(m, unknowns, n_unknowns, knowns, n_knowns, seed, values);
}

/* ---- Model exchange ---- */

FUNCTION(fmi2EnterEventMode)(instance *m) { return enter_mode(m, EVENT_MODE, m->now.mode == CONTINUOUS); }
FUNCTION(fmi2NewDiscreteStates)(instance *m, event_info2 *info) {
    bool changed;
    const int status = perform_events(m, -1, &changed);
    memset(info, 0, sizeof *info);
    info->terminates = m->now.ended_by >= 0;
    info->values_changed = changed;
    return status;
}
FUNCTION(fmi2EnterContinuousTimeMode)(instance *m) { return enter_mode(m, CONTINUOUS, m->now.mode == EVENT_MODE); }
FUNCTION(fmi2CompletedIntegratorStep)(instance *m, int no_set, int *enters_event_mode, int *terminates) {
    (void)m, (void)no_set;
    *enters_event_mode = *terminates = 0;
    return OK;
}
FUNCTION(fmi2SetTime)(instance *m, double t) { return start(m, t); }
FUNCTION(fmi2SetContinuousStates)(instance *m, const double *y, size_t n) {
    if (check_size(m, n, N_Y) != OK) return ERROR;
    memcpy(m->now.y, y, N_Y * sizeof(double));
    return OK;
}
FUNCTION(fmi2GetDerivatives)(instance *m, double *rate, size_t n) {
    return check_size(m, n, N_Y) == OK ? get_rates(m, rate) : ERROR;
}
FUNCTION(fmi2GetEventIndicators)(instance *m, double *z, size_t n) {
    if (check_size(m, n, N_E) != OK) return ERROR;
    indicators(&m->now, z);
    return OK;
}
FUNCTION(fmi2GetContinuousStates)(instance *m, double *y, size_t n) {
    if (check_size(m, n, N_Y) != OK) return ERROR;
    memcpy(y, m->now.y, N_Y * sizeof(double));
    return OK;
}
FUNCTION(fmi2GetNominalsOfContinuousStates)(instance *m, double *nominal, size_t n) {
    size_t i;
    if (check_size(m, n, N_Y) != OK) return ERROR;
    for (i = 0; i < n; i++) nominal[i] = 1.0;
    return OK;
}

/* ---- Co-simulation ---- */

FUNCTION(fmi2DoStep)(instance *m, double t, double length, int no_set) {
    (void)no_set;
    if (step_by(m, t, length) != OK) return ERROR;
    return m->now.ended_by >= 0 ? DISCARD : OK; /* the importer then asks for the status `fmi2Terminated` */
}
FUNCTION(fmi2CancelStep)(instance *m) { return refuse(m, 1); }
FUNCTION(fmi2SetRealInputDerivatives)(instance *m, const reference2 *r, size_t n, const int *order, const double *x) {
    (void)r, (void)order, (void)x;
    return refuse(m, n);
}
FUNCTION(fmi2GetRealOutputDerivatives)(instance *m, const reference2 *r, size_t n, const int *order, double *x) {
    (void)r, (void)order, (void)x;
    return refuse(m, n);
}
FUNCTION(fmi2GetRealStatus)(instance *m, int kind, double *value) {
    *value = m->now.t;
    return kind == 2 ? OK : DISCARD; /* fmi2LastSuccessfulTime */
}
FUNCTION(fmi2GetBooleanStatus)(instance *m, int kind, int *value) {
    *value = m->now.ended_by >= 0;
    return kind == 3 ? OK : DISCARD; /* fmi2Terminated */
}
FUNCTION(fmi2GetStatus)(instance *m, int kind, int *value) {
    (void)m, (void)kind;
    *value = OK;
    return DISCARD; /* only steps that run in the background have this status */
}
FUNCTION(fmi2GetIntegerStatus)(instance *m, int kind, int *value) {
    (void)m, (void)kind;
    *value = 0;
    return DISCARD;
}
FUNCTION(fmi2GetStringStatus)(instance *m, int kind, const char **value) {
    (void)m, (void)kind;
    *value = "";
    return DISCARD;
}
