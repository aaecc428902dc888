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

/* The side from which an event function comes, at the start or after a jump that changes it. At zero, an event with a
   direction is still ahead; one without direction has occurred. */
static int side_of(int j, double t, double g, double g_dot) {
    if (fabs(g) > fabs(g_dot) * rounding(t)) return g > 0.0 ? 1 : -1;
    return directions[j] != 0 ? -directions[j] : g_dot < 0.0 ? -1 : 1;
}

static void set_sides(model_state *s) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    int j;
    if (N_E == 0) return;
    events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    for (j = 0; j < N_E; j++) s->side[j] = side_of(j, s->t, g[j], g_dot[j]);
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

/* The event functions and their rates after a short time. */
static void events_later(const model_state *s, double dt, double *g, double *g_dot) {
    double y[SIZE(N_Y)], condition[SIZE(N_C)] = {0.0};
    advance(s, dt, y);
    events_of(s->t + dt, y, s->w, s->p, g, g_dot, condition);
}

/* Whether an event occurs now, if its condition is met: its function has crossed zero, or crosses it within a rounding
   error. A function that only touches zero does not cross it. */
static bool is_due(const model_state *s, int j, double g, double g_dot) {
    double later[SIZE(N_E)], rates[SIZE(N_E)];
    if (has_crossed(s, j, g)) return true;
    if (s->slack[j] > 0.0 || !(s->side[j] * g_dot < 0.0 && fabs(g) <= fabs(g_dot) * rounding(s->t))) return false;
    events_later(s, 1e-3 * STEP, later, rates);
    return has_crossed(s, j, later[j]);
}

/* Whether the function of an event returns to its side after a jump, by its speed and acceleration. A ball with a
   restitution of zero does not, and a ball whose bounces are shorter than the importer's tolerance does not. */
static bool returns(const model_state *s, int j, bool rests) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], later[SIZE(N_E)], rates[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    double depth, speed, acceleration;
    events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
    events_later(s, 1e-3 * STEP, later, rates);
    depth = -s->side[j] * g[j];
    speed = s->side[j] * g_dot[j];
    acceleration = s->side[j] * (rates[j] - g_dot[j]) / (1e-3 * STEP);
    if (rests) return acceleration >= 0.0;
    return depth < 0.0 || acceleration >= 0.0 || speed * speed > -2.0 * acceleration * depth;
}

/* Updates the sides after a jump of the event `which` from y to `after`. A function that the jump does not change stays
   on its side, so that its event is still due, or does not occur again. The function of the event itself changes to its
   other side if it then crosses zero. Returns false if it crosses zero more than once within a rounding error. */
static bool pass_jump(model_state *s, int which, double at, const double *y, const double *after) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    double g_before[SIZE(N_E)], before[SIZE(N_E)], now[SIZE(N_E)], rate_now[SIZE(N_E)];
    bool is_single = true;
    int j;
    events_of(at, y, s->w, s->p, g_before, before, condition);
    events_of(at, after, s->w, s->p, g, g_dot, condition);
    events_of(s->t, s->y, s->w, s->p, now, rate_now, condition);
    for (j = 0; j < N_E; j++) {
        const double limit = (fabs(before[j]) + fabs(g_dot[j])) * rounding(at);
        const bool is_own = j == which, rests = fabs(g_dot[j]) <= sqrt(DBL_EPSILON) * fabs(before[j]);
        /* A function that has crossed is zero except for the error of the time, unless a changed parameter moved it. */
        const bool is_near = fabs(g_before[j]) <= STEP * fabs(before[j]);
        const bool stays = is_own ? is_near && fabs(g[j]) <= fabs(g_before[j]) + limit
                                  : fabs(g[j] - g_before[j]) <= limit;
        if (!stays) {
            s->side[j] = side_of(j, at, g[j], g_dot[j]);
        } else if (is_own && !rests && directions[j] * g_dot[j] > 0.0) {
            s->side[j] = directions[j];
            is_single = directions[j] * before[j] >= 0.0;
        } else if (is_own) {
            is_single = returns(s, j, rests);
        }
        /* Within a rounding error, the function may not be on this side yet. Without this slack, a ball whose bounces
           are shorter than the importer's tolerance falls through the floor. */
        s->slack[j] = 0.0;
        if (is_own || (is_near && s->side[j] * g_dot[j] >= 0.0))
            s->slack[j] = limit + 2.0 * fmax(0.0, -s->side[j] * now[j]);
    }
    return is_single;
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
static int jump(instance *m, int j, double g, double g_dot) {
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
    rate_of(at, after, m->now.w, m->now.p, rate);
    for (i = 0; i < N_Y; i++) m->now.y[i] = after[i] - shift * rate[i];
    if (!pass_jump(&m->now, j, at, y, after)) {
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

/* The events that occur now. The first due event in alphabetical order jumps, until none is due. `found`: an event that
   occurs now except for rounding errors, or -1. */
static int perform_events(instance *m, int found, bool *changed) {
    double g[SIZE(N_E)], g_dot[SIZE(N_E)], condition[SIZE(N_C)] = {0.0};
    model_state *s = &m->now;
    int j;
    *changed = false;
    while (N_E > 0 && s->ended_by < 0) {
        events_of(s->t, s->y, s->w, s->p, g, g_dot, condition);
        for (j = 0; j < N_E; j++)
            if (is_possible(j, condition) && (j == found || is_due(s, j, g[j], g_dot[j]))) break;
        if (j == N_E) {
            follow_sides(s);
            break;
        }
        if (is_end[j]) s->ended_by = j;
        else if (jump(m, j, g[j], g_dot[j]) != OK) return ERROR;
        else *changed = true;
        found = -1;
    }
    return OK;
}

/* ---- Integration, for co-simulation ---- */

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
