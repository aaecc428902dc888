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
    $real rounding; /* the present time minus t[0], which is rounded [s] */
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
    {$start_root},
    0
};

$model

// common
/* A (rows, columns) becomes a triangle with the same A A^T, by Householder's reflections. */
static inline void ${name}_triangle(int rows, int columns, $real *A) {
    int i, j, k;
    for (i = 0; i < rows; i++) {
        $real *a = A + i * columns, tail = 0, beta, scale;
        for (j = i + 1; j < columns; j++) tail += a[j] * a[j];
        if (tail == 0) continue;
        beta = sqrt$s(a[i] * a[i] + tail);
        if (a[i] > 0) beta = -beta;
        scale = 1 / (beta * (beta - a[i]));
        a[i] -= beta;
        for (k = i + 1; k < rows; k++) {
            $real *b = A + k * columns, along = 0;
            for (j = i; j < columns; j++) along += b[j] * a[j];
            for (j = i; j < columns; j++) b[j] -= scale * along * a[j];
        }
        a[i] = beta;
        for (j = i + 1; j < columns; j++) a[j] = 0;
    }
}

/* The first columns of a triangle A (n_root, columns) are the root of the belief. */
static inline void ${name}_take_root(${name}_belief *b, int columns, $real *A) {
    int r, j;
    ${name}_triangle(${name}_n_root, columns, A);
    for (r = 0; r < ${name}_n_root; r++)
        for (j = 0; j < ${name}_n_root; j++) b->root[r * ${name}_n_root + j] = A[r * columns + j];
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
    const $real before = b->t[0], step = dt + b->rounding;
    int i;
    for (i = ${name}_n_root - 1; i >= ${name}_n; i--) b->mean[i] = b->mean[i - ${name}_n];
    for (i = ${name}_n_times - 1; i > 0; i--) b->t[i] = b->t[i - 1];
    for (i = 0; i < ${name}_n; i++) b->mean[i] = now[i];
    b->t[0] = before + step; /* summation by Kahan */
    b->rounding = step - (b->t[0] - before);
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
        if (measured[c] != measured[c]) continue; /* NaN: a gap */
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
static inline void ${name}_onto($real t, $real *v, const ${name}_settings *s) {
    (void)t, (void)v, (void)s; /* there are no configuration constraints */
}

static inline void ${name}_project(${name}_belief *b, const ${name}_settings *s) {
    (void)b, (void)s; /* there are no configuration constraints */
}

// with_constraints
/* x (coordinates, columns) changes by dx with G dx = -y, dx / weight being the smallest. y (constraints, columns) is
   overwritten. By Gram and Schmidt, twice; rows of G that follow from those before them are left out. */
static inline void ${name}_change(const $real *G, const $real *weight, int columns, $real *y, $real *x) {
    enum { n = ${name}_n, n_q = $coordinates, n_h = $constraints };
    $real Q[n_h * n_q];
    int i, j, k, l, pass;
    for (i = 0; i < n_h; i++) {
        $real *row = Q + i * n_q, largest = 0, rest = 0, size = 0;
        for (k = 0; k < n_q; k++) {
            row[k] = G[i * n + k] * weight[k];
            if (fabs$s(row[k]) > largest) largest = fabs$s(row[k]);
        }
        for (pass = 0; pass < 2; pass++) {
            $real dots[n_h];
            for (l = 0; l < i; l++)
                for (dots[l] = 0, k = 0; k < n_q; k++) dots[l] += Q[l * n_q + k] * row[k];
            for (l = 0; l < i; l++) {
                for (k = 0; k < n_q; k++) row[k] -= dots[l] * Q[l * n_q + k];
                for (j = 0; j < columns; j++) y[i * columns + j] -= dots[l] * y[l * columns + j];
            }
        }
        for (k = 0; k < n_q; k++) {
            if (fabs$s(row[k]) > rest) rest = fabs$s(row[k]);
            size += row[k] * row[k];
        }
        size = rest > ($real)$new_row * largest ? 1 / sqrt$s(size) : 0;
        for (k = 0; k < n_q; k++) row[k] *= size;
        for (j = 0; j < columns; j++) y[i * columns + j] *= size;
    }
    for (k = 0; k < n_q; k++)
        for (j = 0; j < columns; j++)
            for (i = 0; i < n_h; i++) x[k * columns + j] -= weight[k] * Q[i * n_q + k] * y[i * columns + j];
}

/* The nearest coordinates of a state that meet the configuration constraints, by three steps of Gauss and Newton. */
static inline void ${name}_onto($real t, $real *v, const ${name}_settings *s) {
    $real h[$constraints], G[$constraints * ${name}_n], weight[$coordinates];
    int step;
    for (step = 0; step < 3; step++) {
        ${name}_constraints(t, v, 0, &s->parameters, h, G, weight);
        ${name}_change(G, weight, 1, h, v);
    }
}

/* The present state meets the configuration constraints, and its deviations are tangent to them. */
static inline void ${name}_project(${name}_belief *b, const ${name}_settings *s) {
    enum { n = ${name}_n, n_k = ${name}_n_root, n_h = $constraints };
    $real h[n_h], G[n_h * n], weight[$coordinates], y[n_h * n_k];
    int i, j, k;
    ${name}_onto(b->t[0], b->mean, s);
    ${name}_constraints(b->t[0], b->mean, 0, &s->parameters, h, G, weight);
    for (i = 0; i < n_h; i++)
        for (j = 0; j < n_k; j++)
            for (y[i * n_k + j] = 0, k = 0; k < n; k++) y[i * n_k + j] += G[i * n + k] * b->root[k * n_k + j];
    ${name}_change(G, weight, n_k, y, b->root);
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
    ${name}_take_root(b, wide, W);
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
                                const ${name}_settings *s) {
    enum { n = ${name}_n, n_r = ${name}_n_rates, n_w = ${name}_n_noise };
    static const $real part[4] = {0, ($real)0.5, ($real)0.5, 1}, weight[4] = {1, 2, 2, 1};
    const $real h = dt / $substeps;
    $real point[n], rate[n_r], rates[n_r], noise[$modes], e[$noise_size];
    int i, stage, r, c, m;
    ${name}_onto(t, v, s);
    for (r = 0; r < n; r++) point[r] = v[r];
    for (i = 0; i < $substeps; i++) {
        for (r = 0; r < n_r; r++) rate[r] = rates[r] = 0;
        for (stage = 0; stage < 4; stage++) {
            const $real x = (i + part[stage]) / $substeps;
            for (r = 0; r < n_r; r++) point[r] = v[r] + part[stage] * h * rate[r];
            ${name}_polynomials(x, dt, noise);
            for (c = 0; c < n_w; c++)
                for (e[c] = 0, m = 0; m < $modes; m++) e[c] += xi[m * n_w + c] * noise[m];
            ${name}_rates(t + x * dt, point, inputs, e, &s->parameters, rate);
            for (r = 0; r < n_r; r++) rates[r] += weight[stage] * rate[r];
        }
        for (r = 0; r < n_r; r++) v[r] += h / 6 * rates[r];
    }
}

/* The symmetric root L (n, n) of the covariance of a state with the root S (n, n_root), where rows have the size 1; the
   orthonormal rows X (n, n_root) of S = L X, and R = 1 - X X^T. By Jacobi's rotations, which make the rows of S
   orthogonal. L depends on the covariance alone, also where it is singular. */
static inline void ${name}_symmetric(const $real *S, $real *L, $real *X, $real *R) {
    enum { n = ${name}_n, n_k = ${name}_n_root, width = n_k + n };
    $real B[n * width], size[n], value[n], largest = 0; /* B: S beside the rotations */
    int i, j, k, sweep, turned = 1;
    for (i = 0; i < n; i++) {
        for (size[i] = 0, k = 0; k < n_k; k++) size[i] += S[i * n_k + k] * S[i * n_k + k];
        size[i] = size[i] > 0 ? sqrt$s(size[i]) : 1;
        for (k = 0; k < n_k; k++) B[i * width + k] = S[i * n_k + k] / size[i];
        for (k = 0; k < n; k++) B[i * width + n_k + k] = i == k;
    }
    for (sweep = 0; sweep < 40 && turned; sweep++)
        for (turned = 0, i = 0; i < n; i++)
            for (j = i + 1; j < n; j++) {
                $real *a = B + i * width, *b = B + j * width, aa = 0, bb = 0, ab = 0, t, c;
                for (k = 0; k < n_k; k++) aa += a[k] * a[k], bb += b[k] * b[k], ab += a[k] * b[k];
                if (!(fabs$s(ab) > 8 * ($real)$eps * sqrt$s(aa * bb))) continue;
                turned = 1;
                t = (bb - aa) / (2 * ab);
                t = (t < 0 ? -1 : 1) / (fabs$s(t) + sqrt$s(1 + t * t));
                c = 1 / sqrt$s(1 + t * t);
                for (k = 0; k < width; k++) {
                    const $real before = a[k];
                    a[k] = c * (before - t * b[k]);
                    b[k] = c * (t * before + b[k]);
                }
            }
    for (i = 0; i < n; i++) {
        for (value[i] = 0, k = 0; k < n_k; k++) value[i] += B[i * width + k] * B[i * width + k];
        value[i] = sqrt$s(value[i]);
        if (value[i] > largest) largest = value[i];
    }
    for (k = 0; k < n * n; k++) L[k] = R[k] = 0;
    for (k = 0; k < n * n_k; k++) X[k] = 0;
    for (i = 0; i < n; i++) {
        const $real *row = B + i * width, *u = row + n_k;
        const int known = value[i] > ($real)$rank * largest;
        for (j = 0; j < n; j++) {
            for (k = 0; k < n; k++) L[j * n + k] += size[j] * u[j] * value[i] * u[k];
            for (k = 0; k < n && !known; k++) R[j * n + k] += u[j] * u[k];
            for (k = 0; k < n_k && known; k++) X[j * n_k + k] += u[j] * row[k] / value[i];
        }
    }
}

/* The mean (rows,) of the ends of pairs of points (rows, n), and the first n_root + 2 n columns of a root of their
   covariance A (rows, columns). */
static inline void ${name}_moments(int rows, const $real *plus, const $real *minus, const $real *X, const $real *R,
                                   $real *mean, int columns, $real *A) {
    enum { n = ${name}_n, n_k = ${name}_n_root };
    const $real spread = sqrt$s(($real)n);
    int r, i, j;
    for (r = 0; r < rows; r++) {
        const $real *p = plus + r * n, *m = minus + r * n;
        $real *row = A + r * columns;
        for (mean[r] = 0, i = 0; i < n; i++) mean[r] += (p[i] + m[i]) / (2 * n);
        for (j = 0; j < n_k + n; j++) row[j] = 0;
        for (i = 0; i < n; i++) {
            const $real odd = (p[i] - m[i]) / (2 * spread);
            for (j = 0; j < n_k; j++) row[j] += odd * X[i * n_k + j];
            for (j = 0; j < n; j++) row[n_k + j] += odd * R[i * n + j];
            row[n_k + n + i] = (p[i] + m[i] - 2 * mean[r]) / (2 * spread);
        }
    }
}

/* What is known a time dt [s] later. A dt of 0 changes nothing; where it is negative, everything is NaN. */
static inline void ${name}_predict(${name}_belief *b, const ${name}_settings *s, $real dt, const $real *inputs) {
    enum {
        n = ${name}_n, n_r = ${name}_n_rates, n_w = ${name}_n_noise, n_k = ${name}_n_root, columns = n_k + 2 * n,
        before_drift = columns + $modes * n_w, wide = before_drift + ${name}_n_drift
    };
    const $real spread = sqrt$s(($real)n);
    $real L[n * n], X[n * n_k], R[n * n], mean[n], v[2][n], ends[2][n * n], xi[$modes * $noise_size], W[n_k * wide];
    int i, j, r, side;
    if (dt == 0) return;
    if (!(dt > 0)) dt = ($real)NAN;
    ${name}_symmetric(b->root, L, X, R);
    for (r = 0; r < n_k; r++)
        for (j = 0; j < wide; j++) W[r * wide + j] = r >= n && j < n_k ? b->root[(r - n) * n_k + j] : 0;
    for (i = 0; i < n + $modes * n_w; i++) {
        for (side = 0; side < 2; side++) {
            const $real sign = side ? -1 : 1;
            for (r = 0; r < n; r++) v[side][r] = b->mean[r] + (i < n ? sign * spread * L[r * n + i] : 0);
            for (j = 0; j < $modes * n_w; j++) xi[j] = j == i - n ? sign * sqrt$s(s->density[j % $noise_size]) : 0;
            ${name}_flow(b->t[0], dt, v[side], inputs, xi, s);
        }
        for (r = 0; r < n; r++)
            if (i < n) ends[0][r * n + i] = v[0][r], ends[1][r * n + i] = v[1][r];
            else W[r * wide + columns + i - n] = (v[0][r] - v[1][r]) / 2;
    }
    ${name}_moments(n, ends[0], ends[1], X, R, mean, wide, W);
    for (r = n_r; r < n; r++) W[r * wide + before_drift + r - n_r] = sqrt$s(s->drift[r - n_r] * dt);
    ${name}_take_root(b, wide, W);
    ${name}_shift(b, dt, mean);
    ${name}_project(b, s);
}

/* What is known after a measurement that was taken `age` steps ago. Returns 0; or 1, and changes nothing, where so old
   a state is not kept. */
static inline int ${name}_update(${name}_belief *b, const ${name}_settings *s, const $real *measured, const $real *inputs,
                                 int age, ${name}_innovation *innovation) {
    enum { n = ${name}_n, n_k = ${name}_n_root, n_c = ${name}_n_sensors, columns = n_k + 2 * n };
    const $real spread = sqrt$s(($real)n);
    $real L[n * n], X[n * n_k], R[n * n], v[n], z[n_c], ends[2][n_c * n], F[n_c * columns], S[n_k * columns];
    int c, r, i, j, side;
    if (age < 0 || age >= ${name}_n_times) return 1;
    ${name}_symmetric(b->root + age * n * n_k, L, X, R);
    for (i = 0; i < n; i++)
        for (side = 0; side < 2; side++) {
            for (r = 0; r < n; r++) v[r] = b->mean[age * n + r] + (side ? -spread : spread) * L[r * n + i];
            ${name}_onto(b->t[age], v, s);
            ${name}_sensed(b->t[age], v, inputs, &s->parameters, z);
            for (c = 0; c < n_c; c++) ends[side][c * n + i] = z[c];
        }
    ${name}_moments(n_c, ends[0], ends[1], X, R, innovation->predicted, columns, F);
    for (r = 0; r < n_k; r++)
        for (j = 0; j < columns; j++) S[r * columns + j] = j < n_k ? b->root[r * n_k + j] : 0;
    ${name}_measure(s, measured, columns, b->mean, S, F, innovation);
    ${name}_take_root(b, columns, S);
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
    wrong += compare("mean", $n, belief.mean, mean, 0.0);
    wrong += compare("covariance", $n * $n, product, covariance, 0.0);
    return wrong;
}
