/* ---- The functions of FMI 3.0 ---- */

typedef uint32_t reference3;
typedef void (*logger3)(void *environment, int status, const char *category, const char *message);

static void send(const instance *m, int status, const char *text) {
    const char *category = status == DISCARD ? "logStatusDiscard" : "logStatusError";
    ((logger3)m->log)(m->environment, status, category, text);
}

#ifdef FMI3_FUNCTION_PREFIX /* for importers that link several FMUs statically */
#define FULL(name) PREFIXED(FMI3_FUNCTION_PREFIX, name)
#else
#define FULL(name) name
#endif
#define FUNCTION(name) EXPORT int FULL(name)

EXPORT const char *FULL(fmi3GetVersion)(void) { return "3.0"; }

EXPORT void *FULL(fmi3InstantiateModelExchange)(const char *name, const char *token, const char *resources,
                                                bool visible, bool logging, void *environment, logger3 log) {
    (void)resources, (void)visible, (void)logging;
    return create(name, token, false, environment, (function_type)log);
}
EXPORT void *FULL(fmi3InstantiateCoSimulation)(const char *name, const char *token, const char *resources, bool visible,
                                               bool logging, bool event_mode, bool early_return,
                                               const reference3 *intermediate, size_t n_intermediate, void *environment,
                                               logger3 log, void (*intermediate_update)(void)) {
    instance *m = create(name, token, true, environment, (function_type)log);
    (void)resources, (void)visible, (void)logging, (void)event_mode;
    (void)intermediate, (void)n_intermediate, (void)intermediate_update;
    if (m) m->returns_early = early_return;
    return m;
}
EXPORT void *FULL(fmi3InstantiateScheduledExecution)(const char *name, const char *token, const char *resources,
                                                     bool visible, bool logging, void *environment, logger3 log,
                                                     void (*update)(void), void (*lock)(void), void (*unlock)(void)) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}
EXPORT void FULL(fmi3FreeInstance)(instance *m) { destroy(m); }

FUNCTION(fmi3SetDebugLogging)(instance *m, bool on, size_t n, const char *const *categories) {
    (void)m, (void)on, (void)n, (void)categories;
    return OK;
}
FUNCTION(fmi3EnterInitializationMode)(instance *m, bool has_tolerance, double tolerance, double t, bool has_stop,
                                      double stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return start(m, t) == OK ? enter_mode(m, INITIALIZING, m->now.mode == CREATED) : ERROR;
}
FUNCTION(fmi3ExitInitializationMode)(instance *m) { return initialize(m); }
FUNCTION(fmi3Terminate)(instance *m) { return enter_mode(m, TERMINATED, true); }
FUNCTION(fmi3Reset)(instance *m) {
    set_defaults(m);
    return OK;
}
FUNCTION(fmi3EnterConfigurationMode)(instance *m) { return refuse(m, 1); }
FUNCTION(fmi3ExitConfigurationMode)(instance *m) { return refuse(m, 1); }

FUNCTION(fmi3GetFloat64)(instance *m, const reference3 *r, size_t n, double *x, size_t n_x) {
    return check_size(m, n_x, n) == OK ? get_numbers(m, r, n, x) : ERROR;
}
FUNCTION(fmi3SetFloat64)(instance *m, const reference3 *r, size_t n, const double *x, size_t n_x) {
    return check_size(m, n_x, n) == OK ? set_numbers(m, r, n, x) : ERROR;
}
#define NO_VARIABLES(type, c_type) \
    FUNCTION(fmi3Get##type)(instance *m, const reference3 *r, size_t n, c_type *x, size_t n_x) { \
        (void)r, (void)x, (void)n_x; \
        return refuse(m, n); \
    } \
    FUNCTION(fmi3Set##type)(instance *m, const reference3 *r, size_t n, const c_type *x, size_t n_x) { \
        (void)r, (void)x, (void)n_x; \
        return refuse(m, n); \
    }
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
NO_VARIABLES(String, char *)

/* Functions of binary variables, clocks and intervals, with one to three arrays after the value references. */
#define REFUSE_1(name) \
    FUNCTION(name)(instance *m, const reference3 *r, size_t n, const void *a) { \
        (void)r, (void)a; \
        return refuse(m, n); \
    }
#define REFUSE_2(name) \
    FUNCTION(name)(instance *m, const reference3 *r, size_t n, const void *a, const void *b) { \
        (void)r, (void)a, (void)b; \
        return refuse(m, n); \
    }
#define REFUSE_3(name, last) \
    FUNCTION(name)(instance *m, const reference3 *r, size_t n, const void *a, const void *b, last c) { \
        (void)r, (void)a, (void)b, (void)c; \
        return refuse(m, n); \
    }
REFUSE_3(fmi3GetBinary, size_t)
REFUSE_3(fmi3SetBinary, size_t)
REFUSE_1(fmi3GetClock)
REFUSE_1(fmi3SetClock)
REFUSE_2(fmi3GetIntervalDecimal)
REFUSE_3(fmi3GetIntervalFraction, const void *)
REFUSE_1(fmi3GetShiftDecimal)
REFUSE_2(fmi3GetShiftFraction)
REFUSE_1(fmi3SetIntervalDecimal)
REFUSE_2(fmi3SetIntervalFraction)
REFUSE_1(fmi3SetShiftDecimal)
REFUSE_2(fmi3SetShiftFraction)

FUNCTION(fmi3GetNumberOfVariableDependencies)(instance *m, reference3 r, size_t *n) {
    (void)r, (void)n;
    return refuse(m, 1);
}
FUNCTION(fmi3GetVariableDependencies)(instance *m, reference3 r, size_t *places, reference3 *independents,
                                      size_t *independent_places, int *kinds, size_t n) {
    (void)r, (void)places, (void)independents, (void)independent_places, (void)kinds;
    return refuse(m, n);
}

FUNCTION(fmi3GetFMUState)(instance *m, void **copy) { return copy_state(m, copy); }
FUNCTION(fmi3SetFMUState)(instance *m, void *copy) { return restore_state(m, copy); }
FUNCTION(fmi3FreeFMUState)(instance *m, void **copy) {
    (void)m;
    free(*copy);
    *copy = NULL;
    return OK;
}
FUNCTION(fmi3SerializedFMUStateSize)(instance *m, void *copy, size_t *size) {
    (void)m, (void)copy;
    *size = sizeof(model_state);
    return OK;
}
FUNCTION(fmi3SerializeFMUState)(instance *m, void *copy, uint8_t *bytes, size_t size) {
    if (check_size(m, size, sizeof(model_state)) != OK) return ERROR;
    memcpy(bytes, copy, size);
    return OK;
}
FUNCTION(fmi3DeserializeFMUState)(instance *m, const uint8_t *bytes, size_t size, void **copy) {
    if (check_size(m, size, sizeof(model_state)) != OK || copy_state(m, copy) != OK) return ERROR;
    memcpy(*copy, bytes, size);
    return OK;
}
FUNCTION(fmi3GetDirectionalDerivative)(instance *m, const reference3 *unknowns, size_t n_unknowns,
                                       const reference3 *knowns, size_t n_knowns, const double *seed, size_t n_seed,
                                       double *values, size_t n_values) {
    if (check_size(m, n_seed, n_knowns) != OK || check_size(m, n_values, n_unknowns) != OK) return ERROR;
    return get_directional(m, unknowns, n_unknowns, knowns, n_knowns, seed, values);
}
FUNCTION(fmi3GetAdjointDerivative)(instance *m, const reference3 *unknowns, size_t n_unknowns,
                                   const reference3 *knowns, size_t n_knowns, const double *seed, size_t n_seed,
                                   double *values, size_t n_values) {
    (void)unknowns, (void)n_unknowns, (void)knowns, (void)n_knowns, (void)seed, (void)n_seed, (void)values;
    return refuse(m, n_values);
}

/* ---- Model exchange ---- */

FUNCTION(fmi3EnterEventMode)(instance *m) { return enter_mode(m, EVENT_MODE, m->now.mode == CONTINUOUS); }
FUNCTION(fmi3EvaluateDiscreteStates)(instance *m) {
    (void)m; /* there are no discrete variables */
    return OK;
}
FUNCTION(fmi3UpdateDiscreteStates)(instance *m, bool *needs_update, bool *terminates, bool *nominals_changed,
                                   bool *values_changed, bool *has_next_time, double *next_time) {
    const int status = perform_events(m, -1, values_changed);
    *needs_update = *nominals_changed = *has_next_time = false;
    *terminates = m->now.ended_by >= 0;
    *next_time = 0.0;
    return status;
}
FUNCTION(fmi3EnterContinuousTimeMode)(instance *m) { return enter_mode(m, CONTINUOUS, m->now.mode == EVENT_MODE); }
FUNCTION(fmi3CompletedIntegratorStep)(instance *m, bool no_set, bool *enters_event_mode, bool *terminates) {
    (void)m, (void)no_set;
    *enters_event_mode = *terminates = false;
    return OK;
}
FUNCTION(fmi3SetTime)(instance *m, double t) { return start(m, t); }
FUNCTION(fmi3SetContinuousStates)(instance *m, const double *y, size_t n) {
    if (check_size(m, n, N_Y) != OK) return ERROR;
    memcpy(m->now.y, y, N_Y * sizeof(double));
    return OK;
}
FUNCTION(fmi3GetContinuousStateDerivatives)(instance *m, double *rate, size_t n) {
    return check_size(m, n, N_Y) == OK ? get_rates(m, rate) : ERROR;
}
FUNCTION(fmi3GetEventIndicators)(instance *m, double *z, size_t n) {
    if (check_size(m, n, N_E) != OK) return ERROR;
    indicators(&m->now, z);
    return OK;
}
FUNCTION(fmi3GetContinuousStates)(instance *m, double *y, size_t n) {
    if (check_size(m, n, N_Y) != OK) return ERROR;
    memcpy(y, m->now.y, N_Y * sizeof(double));
    return OK;
}
FUNCTION(fmi3GetNominalsOfContinuousStates)(instance *m, double *nominal, size_t n) {
    size_t i;
    if (check_size(m, n, N_Y) != OK) return ERROR;
    for (i = 0; i < n; i++) nominal[i] = 1.0;
    return OK;
}
FUNCTION(fmi3GetNumberOfEventIndicators)(instance *m, size_t *n) {
    (void)m;
    *n = N_E;
    return OK;
}
FUNCTION(fmi3GetNumberOfContinuousStates)(instance *m, size_t *n) {
    (void)m;
    *n = N_Y;
    return OK;
}

/* ---- Co-simulation ---- */

FUNCTION(fmi3EnterStepMode)(instance *m) { return refuse(m, 1); } /* there is no event mode in co-simulation */
FUNCTION(fmi3DoStep)(instance *m, double t, double length, bool no_set, bool *has_event, bool *terminates, bool *early,
                     double *reached) {
    const int status = step_by(m, t, length);
    (void)no_set;
    *has_event = false;
    *terminates = m->now.ended_by >= 0;
    *early = *terminates && m->returns_early && m->now.t < t + length;
    *reached = m->now.t;
    return status;
}
FUNCTION(fmi3GetOutputDerivatives)(instance *m, const reference3 *r, size_t n, const int32_t *orders, double *values,
                                   size_t n_values) {
    (void)r, (void)orders, (void)values, (void)n_values;
    return refuse(m, n);
}
FUNCTION(fmi3ActivateModelPartition)(instance *m, reference3 clock, double t) {
    (void)clock, (void)t;
    return refuse(m, 1);
}
