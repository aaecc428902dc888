/* ---- Events ---- */

/* A crossing within this time of `t` [s] cannot be distinguished from one at `t`. */
static double rounding(double t) { return 64.0 * DBL_EPSILON * fmax(1.0, fabs(t)); }

/* Whether the condition of an event is met. */
static bool is_possible(int j, const double *condition) {
    return condition_of[j] < 0 || condition[condition_of[j]] > 0.0;
}

/* Whether the function of an event has crossed zero in the direction of the event. */
static bool has_crossed(const model_state *s, int j, double g) {
    return s->side[j] * g < -s->slack[j] && (directions[j] == 0 || directions[j] == -s->side[j]);
}

/* Whether an event occurs now: its function has crossed zero, or crosses it within a rounding error. */
static bool is_due(const model_state *s, int j, const double *g, const double *g_dot, const double *condition) {
    const bool comes = s->side[j] * g_dot[j] < 0.0 && (directions[j] == 0 || directions[j] == -s->side[j]);
    return is_possible(j, condition)
        && (has_crossed(s, j, g[j]) || (comes && fabs(g[j]) <= fabs(g_dot[j]) * rounding(s->t)));
}

/* What a jump does to the function of its event: MOVES it away from zero, or leaves it at zero, from where it goes BACK
   or is PASSED through zero, without another jump. */
enum { NOTHING, MOVES, BACK, PASSED };

/* Stores the side of zero of each event function, at the start and after jumps. At zero, an event with a direction is
   still ahead, unless its condition is not met; one without direction has occurred. `effects`: of the jumps that just
   occurred. */
static void set_sides(model_state *s, const int *effects) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    int j;
    if (N_E == 0) return;
    events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    for (j = 0; j < N_E; j++) {
        const bool is_zero = fabs(g[j]) <= fabs(g_dot[j]) * rounding(s->t);
        const bool is_ahead = directions[j] * g_dot[j] > 0.0;
        const int previous = s->side[j], effect = effects ? effects[j] : NOTHING;
        s->side[j] = g[j] > 0.0 ? 1 : -1;
        if (is_zero && directions[j] == 0) s->side[j] = g_dot[j] < 0.0 ? -1 : 1;
        else if (is_zero) s->side[j] = is_ahead && !is_possible(j, condition) ? directions[j] : -directions[j];
        if (effect == PASSED) s->side[j] = -previous;
        if (effect == BACK) s->side[j] = previous;
        /* Within a rounding error, the function may not be on this side yet. Without this slack, a ball whose bounces
           are shorter than the importer's tolerance falls through the floor. */
        s->slack[j] = effect == PASSED || effect == BACK ? 2.0 * fmax(0.0, -s->side[j] * g[j]) : 0.0;
    }
}

/* Updates the sides where no jump has occurred. A function that is zero stays on its side, so that an event that has
   occurred does not occur again. */
static void follow_sides(model_state *s) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    int j;
    if (N_E == 0) return;
    events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    for (j = 0; j < N_E; j++) {
        if (s->side[j] * g[j] < -s->slack[j]) s->side[j] = -s->side[j];
        if (s->side[j] * g[j] > 0.0) s->slack[j] = 0.0;
    }
}

/* The effect of a jump at the event j, from the states before and after it; -1 if the event would occur again. */
static int effect_of(const model_state *s, int j, double t, const double *y, const double *after) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0}, g_before, rate_before, rate;
    events_of(t, y, s->w, s->p, g, g_dot, condition);
    g_before = g[j];
    rate_before = g_dot[j];
    events_of(t, after, s->w, s->p, g, g_dot, condition);
    rate = g_dot[j];
    if (fabs(g[j] - g_before) > (fabs(rate_before) + fabs(rate)) * rounding(t)) return MOVES;
    if (s->side[j] * rate >= 0.0) return BACK;
    /* Functions of the time, for example, cross zero at the same rate after the jump. */
    if (fabs(rate - rate_before) <= sqrt(DBL_EPSILON) * fabs(rate_before) || !is_possible(j, condition)) return PASSED;
    return -1;
}

/* Whether the function of an event returns to its side after a jump, by its speed and acceleration. A ball with a
   restitution of zero does not, and a ball whose bounces are shorter than the importer's tolerance does not. */
static bool returns(const model_state *s, int j) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], later[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    double rate[SIZE(N_Y)], y[SIZE(N_Y)], depth, speed, acceleration;
    const double dt = 1e-3 * STEP;
    int i;
    events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    depth = -s->side[j] * g[j];
    speed = s->side[j] * g_dot[j];
    rate_of(s->t, s->y, s->w, s->p, rate);
    for (i = 0; i < N_Y; i++) y[i] = s->y[i] + dt * rate[i];
    events_of(s->t + dt, y, s->w, s->p, g, later, condition);
    acceleration = s->side[j] * (later[j] - g_dot[j]) / dt;
    if (depth < 0.0 || (speed >= 0.0 && acceleration >= 0.0)) return true;
    return speed > 0.0 && speed * speed > -2.0 * acceleration * depth;
}

/* The time from now to the crossing of an event function, to first order; 0 if the function is not nearly linear. */
static double time_to_crossing(const model_state *s, int j, double g, double g_dot, const double *rate) {
    double y[SIZE(N_Y)], at_g[SIZE(N_E)], at_g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    const double shift = -g / g_dot;
    int i;
    if (!(fabs(shift) <= STEP)) return 0.0;
    for (i = 0; i < N_Y; i++) y[i] = s->y[i] + shift * rate[i];
    events_of(s->t + shift, y, s->w, s->p, at_g, at_g_dot, condition);
    return at_g_dot[j] * g_dot > 0.0 ? shift : 0.0;
}

/* The jump of an event. An importer stops a little after the crossing. So the state is continued to the time of the
   crossing, jumps there, and is continued to the present time. The error is quadratic in the difference. */
static int jump(instance *m, int j, double g, double g_dot, int *effect) {
    double rate[SIZE(N_Y)], y[SIZE(N_Y)], after[SIZE(N_Y)], change[SIZE(N_M)], shift, at;
    int i;
    rate_of(m->now.t, m->now.y, m->now.w, m->now.p, rate);
    shift = time_to_crossing(&m->now, j, g, g_dot, rate);
    at = m->now.t + shift;
    for (i = 0; i < N_Y; i++) y[i] = m->now.y[i] + shift * rate[i];
    jump_of(j, at, y, m->now.w, m->now.p, after);
    if (!is_finite(after, N_Y) || (N_H > 0 && !(correction(&m->now, at, after, change) <= 1e-6))) {
        report(m, ERROR, "t = %.17g: the state after the event '%s' is not finite or violates a configuration "
               "constraint.", at, event_names[j]);
        return ERROR;
    }
    *effect = effect_of(&m->now, j, at, y, after);
    rate_of(at, after, m->now.w, m->now.p, rate);
    for (i = 0; i < N_Y; i++) m->now.y[i] = after[i] - shift * rate[i];
    if (*effect < 0 || (*effect == BACK && !returns(&m->now, j))) {
        report(m, ERROR, "t = %.17g: after the jump at the event '%s', its function crosses zero again at once. "
               "The jumps accumulate at this time.", at, event_names[j]);
        return ERROR;
    }
    if (m->now.n_jumps == 0 || m->now.t - m->now.first_jump > STEP) {
        m->now.first_jump = m->now.t;
        m->now.n_jumps = 0;
    }
    if (++m->now.n_jumps > 64) {
        report(m, ERROR, "t = %.17g: more than 64 jumps within %g s, the last one at the event '%s'. The jumps "
               "accumulate at one time.", m->now.t, STEP, event_names[j]);
        return ERROR;
    }
    return OK;
}

/* All events that occur now, in alphabetical order. An event is skipped if an earlier one has changed the direction in
   which its function crosses zero. `found`: an event that occurs now except for rounding errors, or -1. */
static int perform_events(instance *m, int found, bool *changed) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    bool due[SIZE(N_E)];
    int effects[SIZE(N_E)], j;
    *changed = false;
    if (N_E == 0 || m->now.ended_by >= 0) return OK;
    events_of(m->now.t, m->now.y, m->now.w, m->now.p, g, g_dot, condition);
    for (j = 0; j < N_E; j++) {
        due[j] = is_due(&m->now, j, g, g_dot, condition) || (j == found && is_possible(j, condition));
        effects[j] = NOTHING;
    }
    for (j = 0; j < N_E; j++) {
        if (!due[j] || (*changed && !(m->now.side[j] * g_dot[j] < 0.0))) continue;
        if (is_end[j]) {
            m->now.ended_by = j;
            return OK;
        }
        if (jump(m, j, g[j], g_dot[j], &effects[j]) != OK) return ERROR;
        *changed = true;
        events_of(m->now.t, m->now.y, m->now.w, m->now.p, g, g_dot, condition);
    }
    if (*changed) set_sides(&m->now, effects);
    else follow_sides(&m->now);
    return OK;
}

/* ---- Integration, for co-simulation ---- */

/* A step of the classical method of Runge and Kutta, of order 4. */
static void advance(const model_state *s, double h, double *y) {
    static const double places[] = {0.0, 0.5, 0.5, 1.0}, weights[] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
    double stage[SIZE(N_Y)], rate[SIZE(N_Y)] = {0.0};
    int i, k;
    memcpy(y, s->y, N_Y * sizeof(double));
    for (k = 0; k < 4; k++) {
        for (i = 0; i < N_Y; i++) stage[i] = s->y[i] + places[k] * h * rate[i];
        rate_of(s->t + places[k] * h, stage, s->w, s->p, rate);
        for (i = 0; i < N_Y; i++) y[i] += weights[k] * h * rate[i];
    }
}

/* The length [s] of the step after which an event function crosses zero, by Newton's method between bounds. */
static double length_to_crossing(const model_state *s, int j, double h) {
    double y[SIZE(N_Y)], g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    double low = 0.0, high = h, place = h;
    int k;
    for (k = 0; k < 100; k++) {
        double next;
        advance(s, place, y);
        events_of(s->t + place, y, s->w, s->p, g, g_dot, condition);
        if (has_crossed(s, j, g[j])) high = place; else low = place;
        next = place - g[j] / g_dot[j];
        if (!(next >= low && next <= high)) next = 0.5 * (low + high);
        /* `jump` removes a difference of 1e-9 STEP from the crossing except for its square. */
        if (fabs(next - place) <= 1e-9 * STEP || high - low <= rounding(s->t)) return next;
        place = next;
    }
    return high;
}

/* The time from now to the first event within a step from now, which ends at y1; infinity if there is none, and
   negative if the dependent speeds become singular. */
static double first_event(const model_state *s, double h, const double *y1, int *which) {
    double before[SIZE(N_E)], g[SIZE(N_E)], g_dot[SIZE(N_E)], at_start[SIZE(N_C)] = {0.0}, at_end[SIZE(N_C)] = {0.0};
    double first = INFINITY;
    int j;
    *which = 0;
    if (N_E == 0) return first;
    events_of(s->t, s->y, s->w, s->p, before, g_dot, at_start);
    events_of(s->t + h, y1, s->w, s->p, g, g_dot, at_end);
    for (j = 0; j < N_E; j++) {
        double length;
        /* Numerical steps turn back where det C_dep reaches zero, so its sign does not change. Stop where it would
           reach zero in the next step. */
        if (j == SINGULAR && 2.0 * s->side[j] * g[j] < s->side[j] * before[j]) return -1.0;
        if (!has_crossed(s, j, g[j]) || !(is_possible(j, at_start) || is_possible(j, at_end))) continue;
        length = length_to_crossing(s, j, h);
        if (length < first) *which = j;
        first = fmin(first, length);
    }
    return first;
}

/* One step to time `end`, divided at events. It stops at an event that ends the simulation. */
static int step_to(instance *m, double end) {
    double y[SIZE(N_Y)];
    while (m->now.t < end && m->now.ended_by < 0) {
        const double h = end - m->now.t;
        double first;
        int which, passed;
        bool changed;
        advance(&m->now, h, y);
        if (!is_finite(y, N_Y)) {
            report(m, ERROR, "t = %.17g: the state is not finite after this step.", m->now.t);
            return ERROR;
        }
        first = first_event(&m->now, h, y, &which);
        if (first < 0.0) {
            m->now.ended_by = SINGULAR;
            return OK;
        }
        if (first <= h) advance(&m->now, first, y);
        memcpy(m->now.y, y, N_Y * sizeof(double));
        m->now.t = first < h ? m->now.t + first : end;
        passed = -m->now.side[which];
        if (first > h) follow_sides(&m->now);
        else if (perform_events(m, which, &changed) != OK) return ERROR;
        else if (!changed && m->now.ended_by < 0) {
            m->now.side[which] = passed; /* the condition of the event is not met */
            m->now.slack[which] = 0.0;
        }
    }
    return OK;
}

/* A communication step, divided evenly into steps of at most STEP. */
static int step_by(instance *m, double t, double length) {
    const double tolerance = 1e-9 * fmax(1.0, fabs(t));
    bool changed;
    int64_t i, n;
    if (m->now.mode != STEPPING || !(length >= 0.0 && length < 1e15 * STEP) || !(fabs(t - m->now.t) <= tolerance)) {
        report(m, ERROR, "A communication step of %g s from t = %.17g is not possible: the FMU is at t = %.17g%s.",
               length, t, m->now.t, m->now.mode == STEPPING ? "" : " and is not initialized");
        return ERROR;
    }
    if (m->now.ended_by >= 0) return OK;
    m->now.t = t; /* the importer's time, so that rounding errors do not accumulate */
    if (perform_events(m, -1, &changed) != OK) return ERROR; /* parameters may have changed */
    n = (int64_t)ceil(length / STEP * (1.0 - 1e-9));
    for (i = 1; i <= n && m->now.ended_by < 0; i++)
        if (step_to(m, i == n ? t + length : t + length * (double)i / (double)n) != OK) return ERROR;
    return OK;
}
