// Ticks of the multiplicative filter of attitude and bias for many scenarios: exact transition and noise of a step, then
// a star tracker's three independent rows one after the other. Blocks of the covariance are held as the library does,
// LANES scenarios side by side in vector registers.
#include <math.h>

#define LANES (64 / (int)sizeof(REAL))
typedef REAL V __attribute__((vector_size(64)));
#define EACH(i) for (int i = 0; i < 3; i++)

static inline void sines(V angle, V *s, V *c) {
    REAL in[LANES], out[LANES], co[LANES];
    __builtin_memcpy(in, &angle, sizeof in);
    for (int l = 0; l < LANES; l++) out[l] = sizeof(REAL) == 4 ? sinf(in[l]) : sin(in[l]);
    for (int l = 0; l < LANES; l++) co[l] = sizeof(REAL) == 4 ? cosf(in[l]) : cos(in[l]);
    __builtin_memcpy(s, out, sizeof out);
    __builtin_memcpy(c, co, sizeof co);
}

static inline V root(V a) {
    for (int l = 0; l < LANES; l++) a[l] = sizeof(REAL) == 4 ? sqrtf(a[l]) : sqrt(a[l]);
    return a;
}

// a where x < limit, otherwise b
static inline V pick(V x, REAL limit, V a, V b) {
    for (int l = 0; l < LANES; l++) a[l] = x[l] < limit ? a[l] : b[l];
    return a;
}

// q exp(half-angle sine over angle f times r, cosine c), made a unit quaternion
static inline void turn(V q[4], const V r[3], V f, V c) {
    V x = f * r[0], y = f * r[1], z = f * r[2], w = q[0];
    V p[4] = {w * c - q[1] * x - q[2] * y - q[3] * z, w * x + q[1] * c + q[2] * z - q[3] * y,
              w * y - q[1] * z + q[2] * c + q[3] * x, w * z + q[1] * y - q[2] * x + q[3] * c};
    V s = 1 / root(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
    for (int i = 0; i < 4; i++) q[i] = p[i] * s;
}

static inline void product(V out[3][3], V a[3][3], V b[3][3]) {
    EACH(i) EACH(j) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}

static inline void times_transposed(V out[3][3], V a[3][3], V b[3][3]) {
    EACH(i) EACH(j) out[i][j] = a[i][0] * b[j][0] + a[i][1] * b[j][1] + a[i][2] * b[j][2];
}

typedef struct {
    V q[4], b[3], aa[3][3], ab[3][3], bb[3][3];
} State;

static void tick(State *s, const V rate[3], const V y[4], REAL dt, REAL arw, REAL rrw, const REAL *R) {
    V r[3], xx = {0};
    EACH(i) r[i] = dt * (rate[i] - s->b[i]), xx += r[i] * r[i];
    V one = (V){0} + 1, safe = pick(xx, 1e-20, one * (REAL)1e-20, xx);
    V x = root(safe), sh, ch;
    sines((REAL).5 * x, &sh, &ch);
    V sx = 2 * sh * ch, cx = 1 - 2 * sh * sh;
    V near = xx;
    V sf = 1 / (REAL)6 - near * (1 / (REAL)120 - near * (1 / (REAL)5040 - near * (1 / (REAL)362880)));
    V so = 2 * (1 / (REAL)120 - near * (1 / (REAL)5040 - near * (1 / (REAL)362880)));
    V sg = 1 / (REAL)24 - near * (1 / (REAL)720 - near * (1 / (REAL)40320));
    V f = pick(xx, .25, sf, (x - sx) / (x * safe));
    V o = pick(xx, .25, so, (1 / (REAL)3 - 2 * f) / safe);
    V g = pick(xx, .25, sg, ((REAL).5 - (1 - cx) / safe) / safe);
    V h = 2 * sh * sh / safe;  // (1 - cos x) / x^2
    V n = 2 * sh / x * (REAL).5;
    turn(s->q, r, n, ch);
    V S[3][3] = {{0 * one, -r[2], r[1]}, {r[2], 0 * one, -r[0]}, {-r[1], r[0], 0 * one}}, rr[3][3];
    EACH(i) EACH(j) rr[i][j] = r[i] * r[j];
    V F[3][3], D[3][3], u = one * rrw * rrw * dt, a = u * dt * dt;
    EACH(i) EACH(j) {
        V e = i == j ? one : 0 * one, square = rr[i][j] - xx * e;
        F[i][j] = e - sx / x * S[i][j] + h * square;
        D[i][j] = -dt * (e - h * S[i][j] + f * square);
    }
    V moved[3][3], t1[3][3], t2[3][3], t3[3][3];
    product(moved, F, s->ab);
    product(t1, D, s->bb);
    EACH(i) EACH(j) moved[i][j] += t1[i][j];
    product(t1, F, s->aa);
    times_transposed(t2, D, s->ab);
    EACH(i) EACH(j) t1[i][j] += t2[i][j];
    times_transposed(t2, t1, F);
    times_transposed(t3, moved, D);
    EACH(i) EACH(j) {
        V e = i == j ? one : 0 * one;
        s->aa[i][j] = t2[i][j] + t3[i][j] + (arw * arw * dt + a * 2 * f) * e + a * o * rr[i][j];
        s->ab[i][j] = moved[i][j] - u * dt * ((REAL).5 * e - f * S[i][j] + g * (rr[i][j] - xx * e));
        s->bb[i][j] += u * e;
    }
    // residual: small turn from q to y, by twice the vector part over the scalar, good for small ones
    V *q = s->q, w = q[0] * y[0] + q[1] * y[1] + q[2] * y[2] + q[3] * y[3];
    V v[3] = {q[0] * y[1] - q[1] * y[0] - q[2] * y[3] + q[3] * y[2], q[0] * y[2] - q[2] * y[0] - q[3] * y[1] + q[1] * y[3],
              q[0] * y[3] - q[3] * y[0] - q[1] * y[2] + q[2] * y[1]};
    V vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], k = (2 - 2 / (REAL)3 * vv / (w * w)) / w;
    V e[3] = {k * v[0], k * v[1], k * v[2]}, da[3] = {{0}}, db[3] = {{0}};
    EACH(m) {
        V ca[3], cb[3];
        EACH(i) ca[i] = s->aa[i][m], cb[i] = s->ab[m][i];
        V inv = 1 / (ca[m] + R[m]), step = inv * (e[m] - da[m]);
        EACH(i) da[i] += step * ca[i], db[i] += step * cb[i];
        EACH(i) {
            V wa = inv * ca[i], wb = inv * cb[i];
            EACH(j) {
                s->aa[i][j] -= wa * ca[j];
                s->ab[i][j] -= wa * cb[j];
                s->bb[i][j] -= wb * cb[j];
            }
        }
    }
    V half = (REAL).25 * (da[0] * da[0] + da[1] * da[1] + da[2] * da[2]);  // squared half angle, small
    turn(s->q, da, (REAL).5 * (1 - half / 6), 1 - half / 2);
    EACH(i) s->b[i] += db[i];
}

// state: 34 numbers of every scenario (q, b, aa, ab, bb), read: 7 (rate, attitude); both in groups of LANES scenarios
void run(int groups, int ticks, REAL dt, REAL arw, REAL rrw, const REAL *R, V *state, const V *read) {
    for (int g = 0; g < groups; g++) {
        State s = *(State *)(state + 34 * g);
        for (int k = 0; k < ticks; k++) tick(&s, read + 7 * g, read + 7 * g + 3, dt, arw, rrw, R);
        *(State *)(state + 34 * g) = s;
    }
}
