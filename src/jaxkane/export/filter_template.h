// header
/* $title.

   What is known is a ${name}_belief: the mean of the state, and a root S of its covariance, P = S S^T, row by row.

$of_mean

   What is measured; NaN where nothing was:

$of_sensors

   Inputs, which keep their values from one step to the next:

$of_inputs

   Spectral densities of the white noise, in [unit^2 s] of an input, in [unit^2/s] of all else:

$of_noise
$of_drift

   Begin with a copy of ${name}_start. ${name}_default holds the parameters, standard deviations and densities; of a
   parameter that is estimated, what stands in the mean counts. */

#ifndef ${NAME}_FILTER_H
#define ${NAME}_FILTER_H

#include <math.h>

enum {
    ${name}_n = $n,             /* numbers that are estimated */
    ${name}_n_rates = $rates,       /* of which these have rates, and the others are parameters */
    ${name}_n_sensors = $sensors,
    ${name}_n_noise = $noise,
    ${name}_n_drift = $parameters,
    ${name}_n_times = $times,       /* now, and the states before that are kept */
    ${name}_n_root = ${name}_n * ${name}_n_times
};

$parameters_struct

typedef struct {
    ${name}_parameters parameters;
    $real sigma[$sensors]; /* standard deviations of the sensors */
    $real density[$noise_size];
    $real drift[$parameters_size];
} ${name}_settings;

typedef struct {
    $real t[$times]; /* [s] */
    $real mean[${name}_n_root];
    $real root[${name}_n_root * ${name}_n_root];
} ${name}_belief;

/* `predicted`: what the sensors were expected to read. `difference`, `deviation`: measured less predicted, each after
   those before it, and the standard deviation of that. `nis`: the normalized innovation squared, of `n` measurements. */
typedef struct {
    $real predicted[$sensors], difference[$sensors], deviation[$sensors], nis;
    int n;
} ${name}_innovation;

static const ${name}_settings ${name}_default = {
    {$default},
    {$sigma},
    {$density},
    {$drift}
};

static const ${name}_belief ${name}_start = {
    {$start_t},
    {$start_mean},
    {$start_root}
};

$model

// common
/* A (rows, columns) becomes a root of as many columns as rows, A A^T being the same, and zeros, by Householder's
   reflections: a triangle but for the order of its rows. Rows that those before them determine come last: else rounding
   errors would choose the columns. */
static inline void ${name}_triangle(int rows, int columns, $real *A) {
    $real size[${name}_n_root];
    int done[${name}_n_root], i, j, k, row;
    for (i = 0; i < rows; i++)
        for (done[i] = 0, size[i] = 0, j = 0; j < columns; j++) size[i] += A[i * columns + j] * A[i * columns + j];
    for (i = 0; i < rows; i++) {
        $real *a, tail = 0, beta, scale;
        for (row = -1, k = 0; k < rows; k++) {
            if (done[k]) continue;
            for (tail = 0, j = i; j < columns; j++) tail += A[k * columns + j] * A[k * columns + j];
            if (row < 0) row = k;
            if (tail > ($real)1e-6 * size[k]) { row = k; break; }
        }
        done[row] = 1;
        a = A + row * columns;
        for (tail = 0, j = i + 1; j < columns; j++) tail += a[j] * a[j];
        if (tail == 0) continue;
        beta = sqrt$s(a[i] * a[i] + tail);
        if (a[i] > 0) beta = -beta;
        scale = 1 / (beta * (beta - a[i]));
        a[i] -= beta;
        for (k = 0; k < rows; k++) {
            $real *b = A + k * columns, along = 0;
            if (done[k]) continue;
            for (j = i; j < columns; j++) along += b[j] * a[j];
            for (j = i; j < columns; j++) b[j] -= scale * along * a[j];
        }
        a[i] = beta;
        for (j = i + 1; j < columns; j++) a[j] = 0;
    }
}

/* Legendre's polynomials of time, orthonormal in a step dt, at the part x of it. */
static inline void ${name}_polynomials($real x, $real dt, $real *value) {
    const $real s = 2 * x - 1, scale = 1 / sqrt$s(dt);
    value[0] = scale;
    value[1] = sqrt$s(($real)3) * s * scale;
    value[2] = sqrt$s(($real)5) * (($real)1.5 * s * s - ($real)0.5) * scale;
}

/* The states before move on by one place. */
static inline void ${name}_shift(${name}_belief *b, $real dt, const $real *now) {
    int i;
    for (i = ${name}_n_root - 1; i >= ${name}_n; i--) b->mean[i] = b->mean[i - ${name}_n];
    for (i = ${name}_n_times - 1; i > 0; i--) b->t[i] = b->t[i - 1];
    for (i = 0; i < ${name}_n; i++) b->mean[i] = now[i];
    b->t[0] += dt;
}

/* Measurements one after the other (Potter's form): S has `columns`, F (sensors, columns) is what S does to them. */
static inline void ${name}_measure(const ${name}_settings *s, const $real *measured, int columns, $real *mean, $real *S,
                                   $real *F, ${name}_innovation *innovation) {
    $real error[${name}_n_sensors];
    int c, d, i, j;
    innovation->nis = 0;
    innovation->n = 0;
    for (c = 0; c < ${name}_n_sensors; c++) error[c] = measured[c] - innovation->predicted[c];
    for (c = 0; c < ${name}_n_sensors; c++) {
        $real *f = F + c * columns, variance = s->sigma[c] * s->sigma[c], deviation, scale;
        innovation->difference[c] = 0;
        innovation->deviation[c] = 1;
        if (!isfinite(measured[c])) continue;
        for (j = 0; j < columns; j++) variance += f[j] * f[j];
        deviation = sqrt$s(variance);
        scale = 1 / (deviation * (deviation + s->sigma[c]));
        innovation->difference[c] = error[c];
        innovation->deviation[c] = deviation;
        innovation->nis += error[c] / deviation * (error[c] / deviation);
        innovation->n++;
        for (i = 0; i < ${name}_n_root; i++) {
            $real *row = S + i * columns, along = 0;
            for (j = 0; j < columns; j++) along += row[j] * f[j];
            mean[i] += along * error[c] / variance;
            for (j = 0; j < columns; j++) row[j] -= along * scale * f[j];
        }
        for (d = c + 1; d < ${name}_n_sensors; d++) {
            $real *row = F + d * columns, along = 0;
            for (j = 0; j < columns; j++) along += row[j] * f[j];
            error[d] -= along * error[c] / variance;
            for (j = 0; j < columns; j++) row[j] -= along * scale * f[j];
        }
    }
}

// without_constraints
static inline void ${name}_project(${name}_belief *b, const ${name}_settings *s) {
    (void)b, (void)s; /* there are no configuration constraints */
}

// with_constraints
/* x of A x = b, in the place of b; A (constraints, constraints), positive definite, becomes its triangle where it
   `is_new`. */
static inline void ${name}_solve(int is_new, $real *A, $real *b) {
    enum { n = $constraints };
    int i, j, k;
    for (j = 0; is_new && j < n; j++) {
        for (k = 0; k < j; k++) A[j * n + j] -= A[j * n + k] * A[j * n + k];
        A[j * n + j] = sqrt$s(A[j * n + j]);
        for (i = j + 1; i < n; i++) {
            for (k = 0; k < j; k++) A[i * n + j] -= A[i * n + k] * A[j * n + k];
            A[i * n + j] /= A[j * n + j];
        }
    }
    for (i = 0; i < n; i++) {
        for (k = 0; k < i; k++) b[i] -= A[i * n + k] * b[k];
        b[i] /= A[i * n + i];
    }
    for (i = n - 1; i >= 0; i--) {
        for (k = i + 1; k < n; k++) b[i] -= A[k * n + i] * b[k];
        b[i] /= A[i * n + i];
    }
}

/* Coordinates that meet the configuration constraints, by three steps of Gauss and Newton, and tangent deviations. */
static inline void ${name}_project(${name}_belief *b, const ${name}_settings *s) {
    enum { n_q = $coordinates, n_h = $constraints };
    $real h[n_h], G[n_h * n_q], A[n_h * n_h];
    int step, i, j, k;
    for (step = 0; step < 4; step++) {
        ${name}_constraints(b->t[0], b->mean, 0, &s->parameters, h, G);
        for (i = 0; i < n_h * n_h; i++) {
            A[i] = 0;
            for (k = 0; k < n_q; k++) A[i] += G[i / n_h * n_q + k] * G[i % n_h * n_q + k];
        }
        if (step == 3) break;
        ${name}_solve(1, A, h);
        for (k = 0; k < n_q; k++)
            for (i = 0; i < n_h; i++) b->mean[k] -= G[i * n_q + k] * h[i];
    }
    for (j = 0; j < ${name}_n_root; j++) {
        for (i = 0; i < n_h; i++) {
            h[i] = 0;
            for (k = 0; k < n_q; k++) h[i] += G[i * n_q + k] * b->root[k * ${name}_n_root + j];
        }
        ${name}_solve(j == 0, A, h);
        for (k = 0; k < n_q; k++)
            for (i = 0; i < n_h; i++) b->root[k * ${name}_n_root + j] -= G[i * n_q + k] * h[i];
    }
}

// extended
/* What is known a time dt [s] later. A dt of 0 changes nothing; where it is negative, everything is NaN. */
static inline void ${name}_predict(${name}_belief *b, const ${name}_settings *s, $real dt, const $real *inputs) {
    enum {
        n = ${name}_n, n_r = ${name}_n_rates, n_w = ${name}_n_noise, n_k = ${name}_n_root,
        columns = n_k + $modes * n_w, wide = columns + ${name}_n_drift
    };
    static const $real part[4] = {0, ($real)0.5, ($real)0.5, 1}, weight[4] = {1, 2, 2, 1};
    $real y[n], point[n], rate[n_r], rates[n_r], noise[$modes], slope[n_r * (n + n_w)];
    $real D[n * columns], P[n * columns], k[n_r * columns], sum[n_r * columns], W[n_k * wide];
    const $real h = (dt > 0 ? dt : ($real)NAN) / $substeps;
    int i, stage, r, c, j, m;
    if (dt == 0) return;
    for (r = 0; r < n; r++) {
        y[r] = point[r] = b->mean[r];
        for (j = 0; j < columns; j++) D[r * columns + j] = P[r * columns + j] = j < n_k ? b->root[r * n_k + j] : 0;
    }
    for (i = 0; i < $substeps; i++) {
        for (r = 0; r < n_r; r++) rate[r] = rates[r] = 0;
        for (j = 0; j < n_r * columns; j++) k[j] = sum[j] = 0;
        for (stage = 0; stage < 4; stage++) {
            const $real step = part[stage] * h, x = (i + part[stage]) / $substeps;
            for (r = 0; r < n_r; r++) point[r] = y[r] + step * rate[r];
            for (j = 0; j < n_r * columns; j++) P[j] = D[j] + step * k[j];
            ${name}_rates(b->t[0] + x * dt, point, inputs, &s->parameters, rate, slope);
            ${name}_polynomials(x, dt, noise);
            for (r = 0; r < n_r; r++) {
                const $real *by = slope + r * (n + n_w);
                $real *out = k + r * columns;
                for (j = 0; j < columns; j++) out[j] = 0;
                for (c = 0; c < n; c++)
                    if (by[c] != 0)
                        for (j = 0; j < columns; j++) out[j] += by[c] * P[c * columns + j];
                for (m = 0; m < $modes; m++)
                    for (c = 0; c < n_w; c++)
                        out[n_k + m * n_w + c] += by[n + c] * sqrt$s(s->density[c]) * noise[m];
                rates[r] += weight[stage] * rate[r];
                for (j = 0; j < columns; j++) sum[r * columns + j] += weight[stage] * out[j];
            }
        }
        for (r = 0; r < n_r; r++) y[r] += h / 6 * rates[r];
        for (j = 0; j < n_r * columns; j++) D[j] += h / 6 * sum[j];
    }
    for (r = 0; r < n_k; r++)
        for (j = 0; j < wide; j++) {
            if (r < n && j < columns) W[r * wide + j] = D[r * columns + j];
            else if (r < n) W[r * wide + j] = r == n_r + j - columns ? sqrt$s(s->drift[j - columns] * dt) : 0;
            else W[r * wide + j] = j < n_k ? b->root[(r - n) * n_k + j] : 0;
        }
    ${name}_triangle(n_k, wide, W);
    for (r = 0; r < n_k; r++)
        for (j = 0; j < n_k; j++) b->root[r * n_k + j] = W[r * wide + j];
    ${name}_shift(b, dt > 0 ? dt : ($real)NAN, y);
    ${name}_project(b, s);
}

/* What is known after a measurement that was taken `age` steps ago. Returns 0; or 1, and changes nothing, where so old
   a state is not kept. */
static inline int ${name}_update(${name}_belief *b, const ${name}_settings *s, const $real *measured, const $real *inputs,
                                 int age, ${name}_innovation *innovation) {
    enum { n = ${name}_n, n_k = ${name}_n_root, n_c = ${name}_n_sensors };
    $real slope[n_c * n], F[n_c * n_k];
    int c, r, j;
    if (age < 0 || age >= ${name}_n_times) return 1;
    ${name}_sensed(b->t[age], b->mean + age * n, inputs, &s->parameters, innovation->predicted, slope);
    for (c = 0; c < n_c; c++)
        for (j = 0; j < n_k; j++) {
            F[c * n_k + j] = 0;
            for (r = 0; r < n; r++) F[c * n_k + j] += slope[c * n + r] * b->root[(age * n + r) * n_k + j];
        }
    ${name}_measure(s, measured, n_k, b->mean, b->root, F, innovation);
    ${name}_project(b, s);
    return 0;
}

// unscented
/* The state v a time dt later, by the classical Runge-Kutta method, with noise of these coefficients. */
static inline void ${name}_flow($real t, $real dt, $real *v, const $real *inputs, const $real *xi,
                                const ${name}_parameters *p) {
    enum { n = ${name}_n, n_r = ${name}_n_rates, n_w = ${name}_n_noise };
    static const $real part[4] = {0, ($real)0.5, ($real)0.5, 1}, weight[4] = {1, 2, 2, 1};
    const $real h = dt / $substeps;
    $real point[n], rate[n_r], rates[n_r], noise[$modes], e[$noise_size];
    int i, stage, r, c, m;
    for (r = 0; r < n; r++) point[r] = v[r];
    for (i = 0; i < $substeps; i++) {
        for (r = 0; r < n_r; r++) rate[r] = rates[r] = 0;
        for (stage = 0; stage < 4; stage++) {
            const $real x = (i + part[stage]) / $substeps;
            for (r = 0; r < n_r; r++) point[r] = v[r] + part[stage] * h * rate[r];
            ${name}_polynomials(x, dt, noise);
            for (c = 0; c < n_w; c++)
                for (e[c] = 0, m = 0; m < $modes; m++) e[c] += xi[m * n_w + c] * noise[m];
            ${name}_rates(t + x * dt, point, inputs, e, p, rate);
            for (r = 0; r < n_r; r++) rates[r] += weight[stage] * rate[r];
        }
        for (r = 0; r < n_r; r++) v[r] += h / 6 * rates[r];
    }
}

/* What is known a time dt [s] later. A dt of 0 changes nothing; where it is negative, everything is NaN. */
static inline void ${name}_predict(${name}_belief *b, const ${name}_settings *s, $real dt, const $real *inputs) {
    enum {
        n = ${name}_n, n_r = ${name}_n_rates, n_w = ${name}_n_noise, n_k = ${name}_n_root,
        n_d = n_k + $modes * n_w, columns = 2 * n_d, wide = columns + ${name}_n_drift
    };
    const $real spread = sqrt$s(($real)n_d), scale = 1 / sqrt$s(($real)columns), half = sqrt$s(($real)0.5);
    $real v[n], mean[n], xi[$modes * $noise_size], W[n_k * wide];
    int i, r, j, m, c;
    if (dt == 0) return;
    if (!(dt > 0)) dt = ($real)NAN;
    for (r = 0; r < n; r++) mean[r] = 0;
    for (j = 0; j < columns; j++) {
        const int along = j % n_d;
        const $real sign = j < n_d ? spread : -spread;
        for (r = 0; r < n; r++) v[r] = b->mean[r] + (along < n_k ? sign * b->root[r * n_k + along] : 0);
        for (i = n_k, m = 0; m < $modes; m++)
            for (c = 0; c < n_w; c++, i++) xi[m * n_w + c] = i == along ? sign * sqrt$s(s->density[c]) : 0;
        ${name}_flow(b->t[0], dt, v, inputs, xi, &s->parameters);
        for (r = 0; r < n; r++) W[r * wide + j] = v[r], mean[r] += v[r] / columns;
    }
    for (r = 0; r < n_k; r++)
        for (j = 0; j < wide; j++) {
            $real *x = W + r * wide + j;
            if (r < n && j < columns) *x = scale * (*x - mean[r]);
            else if (r < n) *x = r == n_r + j - columns ? sqrt$s(s->drift[j - columns] * dt) : 0;
            else if (j >= columns || j % n_d >= n_k) *x = 0;
            else *x = (j < n_d ? half : -half) * b->root[(r - n) * n_k + j % n_d];
        }
    ${name}_triangle(n_k, wide, W);
    for (r = 0; r < n_k; r++)
        for (j = 0; j < n_k; j++) b->root[r * n_k + j] = W[r * wide + j];
    ${name}_shift(b, dt, mean);
    ${name}_project(b, s);
}

/* What is known after a measurement that was taken `age` steps ago. Returns 0; or 1, and changes nothing, where so old
   a state is not kept. */
static inline int ${name}_update(${name}_belief *b, const ${name}_settings *s, const $real *measured, const $real *inputs,
                                 int age, ${name}_innovation *innovation) {
    enum { n = ${name}_n, n_k = ${name}_n_root, n_c = ${name}_n_sensors, columns = 2 * n_k };
    const $real spread = sqrt$s(($real)n_k), scale = 1 / sqrt$s(($real)columns), half = sqrt$s(($real)0.5);
    $real v[n], z[n_c], F[n_c * columns], S[n_k * columns];
    int c, r, j;
    if (age < 0 || age >= ${name}_n_times) return 1;
    for (c = 0; c < n_c; c++) innovation->predicted[c] = 0;
    for (j = 0; j < columns; j++) {
        const $real sign = j < n_k ? spread : -spread;
        for (r = 0; r < n; r++) v[r] = b->mean[age * n + r] + sign * b->root[(age * n + r) * n_k + j % n_k];
        ${name}_sensed(b->t[age], v, inputs, &s->parameters, z);
        for (c = 0; c < n_c; c++) F[c * columns + j] = z[c], innovation->predicted[c] += z[c] / columns;
        for (r = 0; r < n_k; r++) S[r * columns + j] = (j < n_k ? half : -half) * b->root[r * n_k + j % n_k];
    }
    for (c = 0; c < n_c; c++)
        for (j = 0; j < columns; j++) F[c * columns + j] = scale * (F[c * columns + j] - innovation->predicted[c]);
    ${name}_measure(s, measured, columns, b->mean, S, F, innovation);
    ${name}_triangle(n_k, columns, S);
    for (r = 0; r < n_k; r++)
        for (j = 0; j < n_k; j++) b->root[r * n_k + j] = S[r * columns + j];
    ${name}_project(b, s);
    return 0;
}

// end
#endif

// test
int main(void) {
    ${name}_belief belief = ${name}_start;
    ${name}_innovation innovation;
    static $real product[$n * $n];
    int wrong = 0, i, j, k;
    $steps
    for (i = 0; i < $n; i++)
        for (j = 0; j < $n; j++)
            for (k = 0; k < $k; k++) product[i * $n + j] += belief.root[i * $k + k] * belief.root[j * $k + k];
    wrong += compare("mean", $n, belief.mean, mean);
    wrong += compare("covariance", $n * $n, product, covariance);
    return wrong;
}
