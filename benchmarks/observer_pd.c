/* The closed loop of jaxatt.systems.observer_pd in C: one SIMD lane per scenario, as the limit of what a CPU can do.

   Same equations, faults, tallies and order of events as the JAX system; a noise generator of its own. REAL is float
   or double. A vector holds the lanes of one 512-bit register; gcc splits it where the machine has shorter ones.
   Everything inside a run is free of branches; what does not change from tick to tick is computed before. */

#include <math.h>
#include <stdint.h>
#include <string.h>
#ifdef __SSE__
#include <xmmintrin.h>
#endif

#define LANES ((int)(64 / sizeof(REAL)))
#define IS_FLOAT (sizeof(REAL) == 4)
#define AXES 3
#define CHANNELS 6
#define SCORES 15
#define INLINE static inline __attribute__((always_inline))

typedef REAL V __attribute__((vector_size(64)));
typedef __typeof__(__builtin_choose_expr(sizeof(REAL) == 4, (int32_t)0, (int64_t)0)) INT;
typedef INT M __attribute__((vector_size(64))); /* mask: every lane all ones or zero */
typedef float F __attribute__((vector_size(64 / sizeof(REAL) * 4)));
typedef int32_t I __attribute__((vector_size(64 / sizeof(REAL) * 4)));
typedef uint32_t U __attribute__((vector_size(64 / sizeof(REAL) * 4)));

typedef struct { V x, y, z; } Vec;
typedef struct { V xx, xy, xz, yy, yz, zz; } Sym; /* a symmetric matrix */
typedef struct { REAL x, y, z; } Row;
typedef struct { Vec q, w, qh, wh; } X; /* continuous state: truth and observer */

/* vectors */

INLINE V all(REAL a) { return (V){0} + a; }
INLINE V pick(M m, V a, V b) { return (V)((m & (M)a) | (~m & (M)b)); }
INLINE V largest(V a, V b) { return pick(a > b, a, b); }
INLINE V smallest(V a, V b) { return pick(a < b, a, b); }
INLINE V root(V a) { for (int i = 0; i < LANES; i++) a[i] = IS_FLOAT ? sqrtf(a[i]) : sqrt(a[i]); return a; }
INLINE V size(V a) { return largest(a, -a); }
INLINE V dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vec plus(Vec a, Vec b) { return (Vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vec minus(Vec a, Vec b) { return (Vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE Vec times(V s, Vec a) { return (Vec){s * a.x, s * a.y, s * a.z}; }
INLINE Vec cross(Vec a, Vec b) {
    return (Vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
INLINE Vec apply(const Sym *m, Vec a) {
    return (Vec){m->xx * a.x + m->xy * a.y + m->xz * a.z, m->xy * a.x + m->yy * a.y + m->yz * a.z,
                 m->xz * a.x + m->yz * a.y + m->zz * a.z};
}
INLINE Sym inverse(const Sym *m) {
    V xx = m->yy * m->zz - m->yz * m->yz, xy = m->xz * m->yz - m->xy * m->zz, xz = m->xy * m->yz - m->xz * m->yy;
    V d = 1 / (m->xx * xx + m->xy * xy + m->xz * xz);
    return (Sym){d * xx, d * xy, d * xz, d * (m->xx * m->zz - m->xz * m->xz), d * (m->xy * m->xz - m->xx * m->yz),
                 d * (m->xx * m->yy - m->xy * m->xy)};
}

/* exp(a) for a <= 0 */
INLINE V decay(V a) {
    static const double c[] = {1, 1, 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
                               1. / 3628800, 1. / 39916800, 1. / 479001600};
    const int degree = IS_FLOAT ? 6 : 12;
    a = largest(a, all(IS_FLOAT ? -87 : -708));
    M k = __builtin_convertvector(a * (REAL)1.4426950408889634 - (REAL)0.5, M); /* rounds, for a <= 0 */
    V n = __builtin_convertvector(k, V);
    V r = (a - n * (REAL)(IS_FLOAT ? 0.693359375 : 0.693147180369123816490))
          - n * (REAL)(IS_FLOAT ? -2.12194440054690583e-4 : 1.90821492927058770002e-10);
    V p = all(c[degree]);
    for (int i = degree - 1; i >= 0; i--) p = p * r + (REAL)c[i];
    return (V)((M)p + (k << (IS_FLOAT ? 23 : 52)));
}

/* noise: xoshiro128+ in every lane, Box-Muller */

typedef struct { U s[4]; } Generator;

INLINE U word(Generator *g) {
    U *s = g->s, out = s[0] + s[3], t = s[1] << 9;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = (s[3] << 11) | (s[3] >> 21);
    return out;
}

static Generator seeded(uint64_t seed) {
    Generator g;
    for (int i = 0; i < LANES; i++)
        for (int j = 0; j < 4; j++) { /* splitmix64 */
            uint64_t z = (seed += 0x9e3779b97f4a7c15u);
            z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
            z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
            g.s[j][i] = (uint32_t)((z ^ (z >> 31)) >> 32);
        }
    return g;
}

INLINE F rootf(F a) { for (int i = 0; i < LANES; i++) a[i] = sqrtf(a[i]); return a; }

/* two standard normal numbers per lane, single precision */
INLINE void two_normals(Generator *g, F *a, F *b) {
    U u = word(g), v = word(g);
    F m = __builtin_convertvector((I)(u >> 8) + 1, F) * 0x1p-24f; /* (0, 1] */
    I e = ((I)m - 0x3f3504f3) >> 23;
    F f = (F)((I)m - (e << 23)) - 1; /* in [sqrt(1/2) - 1, sqrt(2) - 1) */
    F p = f * 7.0376836292e-2f - 1.1514610310e-1f; /* log(1 + f) */
    p = p * f + 1.1676998740e-1f;
    p = p * f - 1.2420140846e-1f;
    p = p * f + 1.4249322787e-1f;
    p = p * f - 1.6668057665e-1f;
    p = p * f + 2.0000714765e-1f;
    p = p * f - 2.4999993993e-1f;
    p = p * f + 3.3333331174e-1f;
    F log_m = __builtin_convertvector(e, F) * 0.6931471806f + (f * f * (p * f - 0.5f) + f);
    F r = rootf((F)((I)(-2 * log_m) & 0x7fffffff)); /* -2 log 1 may come out as -0 */
    r = (F)((U)r | (v << 31)); /* a sign for both, so that half a circle will do */
    F t = __builtin_convertvector((I)(v >> 8) - 0x800000, F) * 0x1.921fb6p-24f; /* [-pi/2, pi/2) */
    F q = t * t;
    F s = (((2.6083159809786593e-6f * q - 1.981069071916863e-4f) * q + 8.333078585565090e-3f) * q - 1.6666659712791443e-1f)
              * q * t + t;
    F c = (((-2.6051615e-7f * q + 2.4760495e-5f) * q - 1.3888378e-3f) * q + 4.1666638e-2f) * q - 0.5f;
    *a = r * s;
    *b = r * (c * q + 1);
}

/* attitude */

/* factor that takes n / d, an MRP, to its inner representative: 1 / d, or -d / |n|^2 */
INLINE V inner_ratio(V nn, V d) {
    M inner = nn <= d * d;
    return pick(inner, all(1), -d) / pick(inner, d, nn);
}
/* G(q) w, times 4 */
INLINE Vec rate4(V qq, Vec q, Vec w) {
    Vec c = cross(q, w);
    V a = 1 - qq, b = 2 * dot(q, w);
    return (Vec){a * w.x + (2 * c.x + b * q.x), a * w.y + (2 * c.y + b * q.y), a * w.z + (2 * c.z + b * q.z)};
}

/* the loop */

typedef struct { /* params, in the order of the leaves of observer_pd.Params, then the largest moment */
    REAL alpha, beta, sigma, k_q, k_w0, eps, J[9], q_d[3], w_d[3], u_max, sign, lambda_max;
} Params;

typedef struct { V onset, end, bias, drift, rate, spread, std, scale; M stuck; } Fault; /* one channel */

typedef struct { /* what stays during a run of one vector of lanes */
    Sym J, J_inv, Jh, Jh_inv;
    V sign, signh, alpha, beta, k_q, u_max, pp;
    Vec p, w_d; /* p = -q_d */
    REAL h;
} Plant;

typedef struct { V gain[CHANNELS], offset[CHANNELS], k_w; } Hold; /* what stays during a tick */

INLINE Vec error(const Plant *c, V qq, Vec q) {
    Vec n = cross(c->p, q);
    V a = 1 - qq, b = 1 - c->pp;
    n = (Vec){a * c->p.x + (b * q.x + 2 * n.x), a * c->p.y + (b * q.y + 2 * n.y), a * c->p.z + (b * q.z + 2 * n.z)};
    return times(inner_ratio(dot(n, n), 1 + (c->pp * qq - 2 * dot(c->p, q))), n);
}

INLINE V clipped(V a, V limit) { return largest(smallest(a, limit), -limit); }

INLINE Vec torque(const Plant *c, V k_w, Vec e_q, Vec e_w) {
    return (Vec){clipped(-(c->k_q * e_q.x) - k_w * e_w.x, c->u_max), clipped(-(c->k_q * e_q.y) - k_w * e_w.y, c->u_max),
                 clipped(-(c->k_q * e_q.z) - k_w * e_w.z, c->u_max)};
}

INLINE X flow(const Plant *c, const Hold *z, X x) {
    Vec yq = {z->gain[0] * x.q.x + z->offset[0], z->gain[1] * x.q.y + z->offset[1], z->gain[2] * x.q.z + z->offset[2]};
    Vec yw = {z->gain[3] * x.w.x + z->offset[3], z->gain[4] * x.w.y + z->offset[4], z->gain[5] * x.w.z + z->offset[5]};
    V yy = dot(yq, yq);
    Vec u = torque(c, z->k_w, error(c, yy, yq), minus(yw, c->w_d));
    Vec gyroscopic = cross(x.w, apply(&c->J, x.w));
    Vec xi_q = minus(yq, x.qh), xi_w = minus(yw, x.wh);
    Vec dw = apply(&c->J_inv, plus(times(c->sign, gyroscopic), u));
    Vec back = cross(xi_q, yq); /* G(-q) = G(q)' */
    V a = (REAL)0.25 * (1 - yy), b = (REAL)0.5 * dot(yq, xi_q);
    Vec m = cross(x.wh, apply(&c->Jh, yw));
    m = (Vec){
        c->signh * m.x + (u.x + (c->beta * xi_w.x + (a * xi_q.x + ((REAL)0.5 * back.x + b * yq.x)))),
        c->signh * m.y + (u.y + (c->beta * xi_w.y + (a * xi_q.y + ((REAL)0.5 * back.y + b * yq.y)))),
        c->signh * m.z + (u.z + (c->beta * xi_w.z + (a * xi_q.z + ((REAL)0.5 * back.z + b * yq.z)))),
    };
    Vec dq = times(all(0.25), rate4(dot(x.q, x.q), x.q, x.w));
    Vec dqh = plus(times(all(0.25), rate4(yy, yq, x.wh)), times(c->alpha, xi_q));
    return (X){dq, dw, dqh, apply(&c->Jh_inv, m)};
}

INLINE X ahead(X x, REAL h, X k) {
    return (X){plus(x.q, times(all(h), k.q)), plus(x.w, times(all(h), k.w)), plus(x.qh, times(all(h), k.qh)),
               plus(x.wh, times(all(h), k.wh))};
}

INLINE X rk4(const Plant *c, const Hold *z, X x) {
    REAL h = c->h;
    X k = flow(c, z, x);
    X sum = ahead(x, h / 6, k);
    k = flow(c, z, ahead(x, h / 2, k));
    sum = ahead(sum, h / 3, k);
    k = flow(c, z, ahead(x, h / 2, k));
    sum = ahead(sum, h / 3, k);
    k = flow(c, z, ahead(x, h, k));
    return ahead(sum, h / 6, k);
}

INLINE V load(const REAL *from) { V a; memcpy(&a, from, sizeof a); return a; }
INLINE V count(M m) { return pick(m, all(1), all(0)); }
INLINE V kept(M m, V a) { return (V)(m & (M)a); }
INLINE V mean(V total, V ticks) { return pick(ticks == 0, all(NAN), total / ticks); }

/* one vector of lanes; normals: NULL, or those of these lanes, (ticks, 6, n); drawn: draw them */
static inline __attribute__((always_inline)) void run(
    const Params *params, const REAL *scenario, const REAL *normals, int drawn, uint64_t seed, long n, long ticks,
    int substeps, REAL dt, REAL *out) {
    const REAL *leaf = scenario;
#define NEXT (leaf += n, load(leaf - n))
#define NEXT_VEC {NEXT, NEXT, NEXT}
    X x = {NEXT_VEC, NEXT_VEC, NEXT_VEC, NEXT_VEC};
    V m[9];
    for (int i = 0; i < 9; i++) m[i] = NEXT;
    Plant c = {.J = {m[0], m[1], m[2], m[4], m[5], m[8]}};
    for (int i = 0; i < 9; i++) m[i] = all(params->J[i]);
    c.Jh = (Sym){m[0], m[1], m[2], m[4], m[5], m[8]};
    c.J_inv = inverse(&c.J);
    c.Jh_inv = inverse(&c.Jh);
    c.sign = NEXT;
    c.signh = all(params->sign);
    c.alpha = all(params->alpha);
    c.beta = all(params->beta);
    c.k_q = all(params->k_q);
    c.u_max = all(params->u_max);
    c.p = (Vec){all(-params->q_d[0]), all(-params->q_d[1]), all(-params->q_d[2])};
    c.pp = dot(c.p, c.p);
    c.w_d = (Vec){all(params->w_d[0]), all(params->w_d[1]), all(params->w_d[2])};
    c.h = dt / substeps;
    V std_q = NEXT, std_w = NEXT, onset = all(INFINITY);
    Fault fault[CHANNELS];
    for (int i = 0; i < CHANNELS; i++) {
        Fault *f = &fault[i];
        f->onset = NEXT, f->end = NEXT, f->bias = NEXT, f->drift = NEXT, f->rate = -1 / NEXT;
        V random = NEXT;
        f->scale = NEXT, f->std = i < AXES ? std_q : std_w;
        V grown = NEXT * f->std;
        f->spread = root(grown * grown + random * random), f->stuck = NEXT > 0;
        onset = smallest(onset, f->onset);
    }
    Generator g = seeded(seed);
    Hold z = {.k_w = all(params->k_w0)};
    V y[CHANNELS] = {x.q.x, x.q.y, x.q.z, x.w.x, x.w.y, x.w.z};
    const REAL lambda = params->eps * params->lambda_max, never = -INFINITY, start_up = 20, band = 0.01 * 0.01;
    V delay = all(INFINITY), start_total = {0}, start_ticks = {0}, false_total = {0}, false_ticks = {0};
    V miss_total = {0}, ill_ticks = {0}, sum_q = {0}, sum_w = {0}, sum_u = {0}, ill_q = {0}, ill_w = {0}, ill_u = {0};
    V peak_q = all(never), peak_w = all(never), peak_u = all(never), outside = all(never), end = all(never);
    M ok = ~(M){0};

    for (long k = 0; k < ticks; k++) {
        V t = all((REAL)k * dt);
        x.q = times(inner_ratio(dot(x.q, x.q), all(1)), x.q);

        /* sense */
        V noise[CHANNELS] = {0};
        if (normals)
            for (int i = 0; i < CHANNELS; i++) noise[i] = load(normals + (k * CHANNELS + i) * n);
        if (drawn)
            for (int i = 0; i < CHANNELS; i += 2) {
                F a, b;
                two_normals(&g, &a, &b);
                noise[i] = __builtin_convertvector(a, V);
                noise[i + 1] = __builtin_convertvector(b, V);
            }
        V truth[CHANNELS] = {x.q.x, x.q.y, x.q.z, x.w.x, x.w.y, x.w.z};
        M ill = {0};
        for (int i = 0; i < CHANNELS; i++) {
            const Fault *f = &fault[i];
            M on = (t >= f->onset) & (t < f->end), stuck = on & f->stuck;
            V faulty = f->bias + (f->drift - f->drift * decay(kept(on, t - f->onset) * f->rate)) + f->spread * noise[i];
            z.gain[i] = kept(~stuck, pick(on, f->scale, all(1)));
            z.offset[i] = pick(stuck, y[i], pick(on, faulty, f->std * noise[i]));
            y[i] = z.gain[i] * truth[i] + z.offset[i];
            ill |= on;
        }
        Vec yq = {y[0], y[1], y[2]}, yw = {y[3], y[4], y[5]};

        /* decide */
        V hh = dot(x.qh, x.qh);
        M near = hh - 1 <= 2 * dot(x.qh, yq); /* |qh - y| <= |shadow - y|, multiplied out */
        x.qh = times(pick(near, all(1), -1 / hh), x.qh);
        Vec xi_q = minus(yq, x.qh), xi_w = minus(yw, x.wh);
        V xi = root(dot(xi_q, xi_q) + dot(xi_w, xi_w));
        M alarm = ~(xi <= params->sigma);
        Vec ey = error(&c, dot(yq, yq), yq), ew = minus(yw, c.w_d);
        V ee = dot(ey, ey);
        V floor = lambda / 4 * (3 + 2 * root(ee) + 3 * ee) + (REAL)1.5;
        V rate = lambda * root(dot(ew, ew)) + 1 + ee, s = z.k_w - floor;
        V elapsed = all(k > 0 ? dt / params->eps : 0);
        z.k_w = pick(s > 0, floor + root(largest(s * s - rate * rate * elapsed, all(0))), z.k_w);
        Vec u = torque(&c, z.k_w, ey, ew);

        /* score */
        Vec e_q = error(&c, dot(x.q, x.q), x.q), e_w = minus(x.w, c.w_d);
        M before = t < onset, start = t < start_up;
        V qq = dot(e_q, e_q), ww = dot(e_w, e_w), uu = dot(u, u);
        delay = smallest(delay, pick(alarm & ~before, t - onset, all(INFINITY)));
        M early = start & before, later = ~start & before;
        start_ticks += count(early), start_total += count(early & alarm);
        false_ticks += count(later), false_total += count(later & alarm);
        ill_ticks += count(ill), miss_total += count(ill & ~alarm);
        sum_q += qq, sum_w += ww, sum_u += uu;
        ill_q += kept(ill, qq), ill_w += kept(ill, ww), ill_u += kept(ill, uu);
        peak_q = pick(start, peak_q, largest(peak_q, qq)); /* squares; the root is taken at the end */
        peak_w = pick(start, peak_w, largest(peak_w, ww));
        peak_u = largest(peak_u, uu);
        end = pick(before, t, end);
        outside = pick(before & (qq > band), t, outside);
        V sum = qq + ww + uu + xi + z.k_w + (x.q.x + x.q.y + x.q.z + x.w.x + x.w.y + x.w.z);
        ok &= size(sum) < INFINITY;

        for (int i = 0; i < substeps; i++) x = rk4(&c, &z, x);
    }
    V all_ticks = all(ticks), settled = pick(outside == end, all(INFINITY), largest(outside, all(0)));
    V value[SCORES] = {
        delay,
        mean(start_total, start_ticks),
        mean(false_total, false_ticks),
        mean(miss_total, ill_ticks),
        root(mean(sum_q, all_ticks)),
        root(mean(sum_w, all_ticks)),
        root(mean(ill_q, ill_ticks)),
        root(mean(ill_w, ill_ticks)),
        pick(peak_q < 0, all(NAN), root(peak_q)),
        pick(peak_w < 0, all(NAN), root(peak_w)),
        pick(end < 0, all(NAN), settled),
        root(mean(sum_u, all_ticks)),
        root(mean(ill_u, ill_ticks)),
        pick(peak_u < 0, all(NAN), root(peak_u)),
        count(ok),
    };
    for (int i = 0; i < SCORES; i++) memcpy(out + i * n, &value[i], sizeof(V));
}

/* n scenarios, a multiple of lanes(); params (24), scenario (78, n): leaves of the system's trees in their order;
   noise: 0 none, 1 drawn here, 2 given in normals (ticks, 6, n); out (15, n): Scores */
void observer_pd(const REAL *params, const REAL *scenario, const REAL *normals, int noise, uint64_t seed, long n,
                 long ticks, int substeps, double dt, REAL *out) {
#ifdef __SSE__
    unsigned int csr = _mm_getcsr();
    _mm_setcsr(csr | 0x8040); /* numbers too small to be normal are zero, as XLA has it */
#endif
    for (long i = 0; i < n; i += LANES) {
        uint64_t own = seed * 0x2545f4914f6cdd1du + (uint64_t)i * 0xd1342543de82ef95u;
        const Params *p = (const Params *)params;
        if (noise == 0) run(p, scenario + i, 0, 0, own, n, ticks, substeps, dt, out + i);
        if (noise == 1) run(p, scenario + i, 0, 1, own, n, ticks, substeps, dt, out + i);
        if (noise == 2) run(p, scenario + i, normals + i, 0, own, n, ticks, substeps, dt, out + i);
    }
#ifdef __SSE__
    _mm_setcsr(csr);
#endif
}

int lanes(void) { return LANES; }
