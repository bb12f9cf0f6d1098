/* The closed loop of jaxatt.loops.observer_pd in C: one SIMD lane per scenario, as the limit of what a CPU can do.

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
#define START_UP 20 /* [s] */
#define BAND 0.01 /* of settling, MRP */
#ifndef INLINE /* without it gcc compiles several times as fast */
#define INLINE static inline __attribute__((always_inline))
#endif

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

/* vectors; gcc makes one instruction of each of these loops */

#define EACH _Pragma("GCC unroll 1") for (int i = 0; i < LANES; i++)

INLINE V all(REAL a) { return (V){0} + a; }
INLINE V pick(M m, V a, V b) { EACH a[i] = m[i] ? a[i] : b[i]; return a; }
INLINE V largest(V a, V b) { EACH a[i] = a[i] > b[i] ? a[i] : b[i]; return a; }
INLINE V smallest(V a, V b) { EACH a[i] = a[i] < b[i] ? a[i] : b[i]; return a; }
INLINE V root(V a) { EACH a[i] = IS_FLOAT ? sqrtf(a[i]) : sqrt(a[i]); return a; }
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

INLINE Sym scaled(V s, Sym m) { return (Sym){s * m.xx, s * m.xy, s * m.xz, s * m.yy, s * m.yz, s * m.zz}; }

/* 2^a for a <= 0; Taylor's series of the rest, in [-1/2, 1/2] */
INLINE V exp2_of(V a) {
    static const double c[] = {
        1.0, 6.9314718055994529e-1, 2.4022650695910069e-1, 5.5504108664821576e-2, 9.6181291076284769e-3,
        1.3333558146428443e-3, 1.5403530393381608e-4, 1.5252733804059840e-5, 1.3215486790144307e-6,
        1.0178086009239699e-7, 7.0549116208011228e-9, 4.4455382718708111e-10, 2.5678435993488201e-11};
    const int degree = IS_FLOAT ? 6 : 12;
    a = largest(a, all(IS_FLOAT ? -126 : -1022));
    M k = __builtin_convertvector(a - (REAL)0.5, M); /* rounds, for a <= 0 */
    V r = a - __builtin_convertvector(k, V), p = all(c[degree]);
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

INLINE F rootf(F a) { EACH a[i] = sqrtf(a[i]); return a; }

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
    F t = __builtin_convertvector((I)(v >> 8) - 0x800000, F) * 0x1.921fb6p-23f; /* [-pi/2, pi/2) */
    F q = t * t;
    F s = (((2.6083159809786593e-6f * q - 1.981069071916863e-4f) * q + 8.333078585565090e-3f) * q - 1.6666659712791443e-1f)
              * q * t + t;
    F c = (((-2.6051615e-7f * q + 2.4760495e-5f) * q - 1.3888378e-3f) * q + 4.1666638e-2f) * q - 0.5f;
    *a = r * s;
    *b = r * (c * q + 1);
}

/* attitude; every product goes with a sum into one instruction, so sums are written from the right */

/* a x b + c */
INLINE Vec cross_plus(Vec a, Vec b, Vec c) {
    return (Vec){a.y * b.z - (a.z * b.y - c.x), a.z * b.x - (a.x * b.z - c.y), a.x * b.y - (a.y * b.x - c.z)};
}
/* a v + b w + c */
INLINE Vec sum_plus(V a, Vec v, V b, Vec w, Vec c) {
    return (Vec){a * v.x + (b * w.x + c.x), a * v.y + (b * w.y + c.y), a * v.z + (b * w.z + c.z)};
}
INLINE Vec twice(Vec a) { return plus(a, a); }

/* the loop */

typedef struct { /* params, in the order of the leaves of observer_pd.Params, then the largest moment */
    REAL alpha, beta, sigma, k_q, k_w0, eps, J[9], q_d[3], w_d[3], u_max, lambda_max;
} Params;

typedef struct { V onset, end, bias, drift, settled, rate, spread, std, scale; M stuck; } Fault; /* one channel */

typedef struct { /* what stays during a run of one vector of lanes */
    Sym J4, J_inv4, Jh4, Jh_inv4; /* 4 J and its inverse; those of the observer */
    V alpha4, beta4, k4_q, u4_max, pp;
    Vec p, w_d; /* p = -q_d */
    REAL h;
} Plant;

typedef struct { V gain[CHANNELS], offset[CHANNELS], k_w, k4_w; Vec wanted; } Hold; /* what stays during a tick */

typedef struct { /* what a sweep keeps: sums, counts, extremes */
    V delay, start_alarms, start_ticks, false_alarms, false_ticks, missed, faulty_ticks, sum_q, sum_w, sum_u, faulty_q,
        faulty_w, faulty_u, peak_q, peak_w, peak_u, outside, end;
    M ok;
} Tally;

typedef struct { Vec q, w, u4; } Seen; /* readings, and four times the torque that they give */

typedef struct { Plant c; Hold z; X x; Seen seen; Fault fault[CHANNELS]; V onset, y[CHANNELS]; Generator g; Tally s; } Loop;

typedef struct { Vec n; V ratio; } Error; /* e_q = ratio n */

/* MRP product of p and q, inner representative. With d the denominator, |n|^2 = d ((1 + pp) (1 + qq) - d). */
INLINE Error error(const Plant *c, V qq, Vec q) {
    V a = 1 - qq, b = 1 - c->pp, e = 1 + c->pp;
    Vec p2 = twice(c->p);
    Vec n = cross_plus(p2, q, (Vec){a * c->p.x + b * q.x, a * c->p.y + b * q.y, a * c->p.z + b * q.z});
    V d = (c->pp * qq + 1) - p2.x * q.x - p2.y * q.y - p2.z * q.z;
    V other = d - (e * qq + e);
    return (Error){n, 1 / pick(other + d >= 0, d, other)};
}

INLINE V clipped(V a, V limit) { return largest(smallest(a, limit), -limit); }

/* 4 u, at a rate reading w */
INLINE Vec torque4(const Plant *c, const Hold *z, Error e, Vec w) {
    V k = c->k4_q * e.ratio;
    return (Vec){clipped(z->wanted.x - k * e.n.x - z->k4_w * w.x, c->u4_max),
                 clipped(z->wanted.y - k * e.n.y - z->k4_w * w.y, c->u4_max),
                 clipped(z->wanted.z - k * e.n.z - z->k4_w * w.z, c->u4_max)};
}

INLINE Seen see(const Plant *c, const Hold *z, X x) {
    Vec yq = {z->gain[0] * x.q.x + z->offset[0], z->gain[1] * x.q.y + z->offset[1], z->gain[2] * x.q.z + z->offset[2]};
    Vec yw = {z->gain[3] * x.w.x + z->offset[3], z->gain[4] * x.w.y + z->offset[4], z->gain[5] * x.w.z + z->offset[5]};
    return (Seen){yq, yw, torque4(c, z, error(c, dot(yq, yq), yq), yw)};
}

/* dx/dt, of the attitudes four times that */
INLINE X flow(const Plant *c, X x, Seen y) {
    Vec yq = y.q, yw = y.w, u4 = y.u4;
    Vec xi_q = minus(yq, x.qh), xi_w = minus(yw, x.wh), y2 = twice(yq), q2 = twice(x.q);
    V a = 1 - dot(yq, yq);
    Vec m = {c->beta4 * xi_w.x + u4.x, c->beta4 * xi_w.y + u4.y, c->beta4 * xi_w.z + u4.z};
    m = cross_plus(apply(&c->Jh4, yw), x.wh, m);
    m = cross_plus(xi_q, y2, sum_plus(a, xi_q, dot(y2, xi_q), yq, m));
    Vec dqh = cross_plus(y2, x.wh, sum_plus(a, x.wh, dot(y2, x.wh), yq, times(c->alpha4, xi_q)));
    V a_q = 1 - dot(x.q, x.q), b_q = dot(x.q, x.w);
    Vec dq = cross_plus(q2, x.w, (Vec){a_q * x.w.x + b_q * q2.x, a_q * x.w.y + b_q * q2.y, a_q * x.w.z + b_q * q2.z});
    return (X){dq, apply(&c->J_inv4, cross_plus(apply(&c->J4, x.w), x.w, u4)), dqh, apply(&c->Jh_inv4, m)};
}

INLINE X flow_at(const Plant *c, const Hold *z, X x) { return flow(c, x, see(c, z, x)); }

INLINE X ahead(X x, REAL h, X k) {
    V h1 = all(h), h4 = all(h / 4);
    return (X){plus(x.q, times(h4, k.q)), plus(x.w, times(h1, k.w)), plus(x.qh, times(h4, k.qh)),
               plus(x.wh, times(h1, k.wh))};
}
INLINE X added(X a, X b) {
    return (X){plus(a.q, b.q), plus(a.w, b.w), plus(a.qh, b.qh), plus(a.wh, b.wh)};
}

/* one step of several vectors side by side: the processor fills the waits of one with the work of the other */
INLINE void rk4(Loop *l, int side) {
    X k1[2], k2[2], k3[2];
    for (int j = 0; j < side; j++) k1[j] = flow(&l[j].c, l[j].x, l[j].seen);
    for (int j = 0; j < side; j++) k2[j] = flow_at(&l[j].c, &l[j].z, ahead(l[j].x, l[j].c.h / 2, k1[j]));
    for (int j = 0; j < side; j++) k3[j] = flow_at(&l[j].c, &l[j].z, ahead(l[j].x, l[j].c.h / 2, k2[j]));
    for (int j = 0; j < side; j++) {
        REAL h = l[j].c.h;
        X ends = added(k1[j], flow_at(&l[j].c, &l[j].z, ahead(l[j].x, h, k3[j])));
        l[j].x = ahead(ahead(l[j].x, h / 3, added(k2[j], k3[j])), h / 6, ends);
    }
}

INLINE V load(const REAL *from) { V a; memcpy(&a, from, sizeof a); return a; }
INLINE V count(M m) { return pick(m, all(1), all(0)); }
INLINE V kept(M m, V a) { return (V)(m & (M)a); }
INLINE V mean(V total, V ticks) { return pick(ticks == 0, all(NAN), total / ticks); }

static const REAL never = -INFINITY;

INLINE void begin(Loop *l, const Params *params, const REAL *scenario, uint64_t seed, long n, int substeps, REAL dt) {
    const REAL *leaf = scenario;
#define NEXT (leaf += n, load(leaf - n))
    V *x = (V *)&l->x, m[9];
    for (int i = 0; i < 12; i++) x[i] = NEXT;
    for (int i = 0; i < 9; i++) m[i] = NEXT;
    Plant *c = &l->c;
    c->J4 = scaled(all(4), (Sym){m[0], m[1], m[2], m[4], m[5], m[8]});
    for (int i = 0; i < 9; i++) m[i] = all(params->J[i]);
    c->Jh4 = scaled(all(4), (Sym){m[0], m[1], m[2], m[4], m[5], m[8]});
    c->J_inv4 = inverse(&c->J4);
    c->Jh_inv4 = inverse(&c->Jh4);
    c->alpha4 = all(4 * params->alpha);
    c->beta4 = all(4 * params->beta);
    c->k4_q = all(4 * params->k_q);
    c->u4_max = all(4 * params->u_max);
    c->p = (Vec){all(-params->q_d[0]), all(-params->q_d[1]), all(-params->q_d[2])};
    c->pp = dot(c->p, c->p);
    c->w_d = (Vec){all(params->w_d[0]), all(params->w_d[1]), all(params->w_d[2])};
    c->h = dt / substeps;
    V std_q = NEXT, std_w = NEXT;
    l->onset = all(INFINITY);
    for (int i = 0; i < CHANNELS; i++) {
        Fault *f = &l->fault[i];
        f->onset = NEXT, f->end = NEXT, f->bias = NEXT, f->drift = NEXT, f->rate = (REAL)-1.4426950408889634 / NEXT;
        V random = NEXT;
        f->scale = NEXT, f->std = i < AXES ? std_q : std_w;
        V grown = NEXT * f->std;
        f->spread = root(grown * grown + random * random), f->stuck = NEXT > 0;
        f->stuck |= NEXT > 0; /* a missing reading, which this program holds */
        f->scale = kept(~f->stuck, f->scale), f->settled = f->bias + f->drift;
        l->onset = smallest(l->onset, f->onset);
        l->y[i] = x[i];
    }
#undef NEXT
    l->g = seeded(seed);
    l->z.k_w = all(params->k_w0);
    l->s = (Tally){.delay = all(INFINITY), .peak_q = all(never), .peak_w = all(never), .peak_u = all(never),
                   .outside = all(never), .end = all(never), .ok = ~(M){0}};
}

INLINE void tick(Loop *l, const Params *params, const REAL *normals, int drawn, long k, REAL dt, long n) {
    const Plant *c = &l->c;
    Hold *z = &l->z;
    Tally *s = &l->s;
    X x = l->x;
    V t = all((REAL)k * dt);
    V outside = dot(x.q, x.q);
    x.q = times(1 / pick(outside > 1, -outside, all(1)), x.q);

    /* sense */
    V noise[CHANNELS] = {0};
    if (normals)
        for (int i = 0; i < CHANNELS; i++) noise[i] = load(normals + (k * CHANNELS + i) * n);
    if (drawn)
        for (int i = 0; i < CHANNELS; i += 2) {
            F a, b;
            two_normals(&l->g, &a, &b);
            noise[i] = __builtin_convertvector(a, V);
            noise[i + 1] = __builtin_convertvector(b, V);
        }
    V truth[CHANNELS] = {x.q.x, x.q.y, x.q.z, x.w.x, x.w.y, x.w.z}, *y = l->y;
    M faulty = {0};
    for (int i = 0; i < CHANNELS; i++) {
        const Fault *f = &l->fault[i];
        M on = (t >= f->onset) & (t < f->end);
        V errs = f->settled - f->drift * exp2_of(largest(t - f->onset, all(0)) * f->rate) + f->spread * noise[i];
        z->gain[i] = pick(on, f->scale, all(1));
        z->offset[i] = pick(on, pick(f->stuck, y[i], errs), f->std * noise[i]);
        y[i] = z->gain[i] * truth[i] + z->offset[i];
        faulty |= on;
    }
    Vec yq = {y[0], y[1], y[2]}, yw = {y[3], y[4], y[5]};

    /* decide */
    V hh = dot(x.qh, x.qh);
    M near = hh - 1 <= 2 * dot(x.qh, yq); /* |qh - y| <= |shadow - y|, multiplied out */
    x.qh = times(pick(near, all(1), -1 / hh), x.qh);
    Vec xi_q = minus(yq, x.qh), xi_w = minus(yw, x.wh);
    V xi = root(dot(xi_q, xi_q) + dot(xi_w, xi_w));
    M alarm = ~(xi <= params->sigma);
    Error ey = error(c, dot(yq, yq), yq);
    Vec ew = minus(yw, c->w_d);
    V ee = ey.ratio * ey.ratio * dot(ey.n, ey.n);
    REAL lambda = params->eps * params->lambda_max;
    V floor = lambda / 4 * (3 + 2 * root(ee) + 3 * ee) + (REAL)1.5;
    V rate = lambda * root(dot(ew, ew)) + 1 + ee, above = z->k_w - floor;
    V elapsed = all(k > 0 ? dt / params->eps : 0);
    z->k_w = pick(above > 0, floor + root(largest(above * above - rate * rate * elapsed, all(0))), z->k_w);
    z->k4_w = 4 * z->k_w;
    z->wanted = times(z->k4_w, c->w_d);
    Vec u4 = torque4(c, z, ey, yw);
    l->seen = (Seen){yq, yw, u4};

    /* score */
    Error e_q = error(c, dot(x.q, x.q), x.q);
    Vec e_w = minus(x.w, c->w_d);
    M before = t < l->onset, start = t < (REAL)START_UP, early = start & before, later = ~start & before;
    V qq = e_q.ratio * e_q.ratio * dot(e_q.n, e_q.n), ww = dot(e_w, e_w), uu = dot(u4, u4) / 16;
    s->delay = smallest(s->delay, pick(alarm & ~before, t - l->onset, all(INFINITY)));
    s->start_ticks += count(early), s->start_alarms += count(early & alarm);
    s->false_ticks += count(later), s->false_alarms += count(later & alarm);
    s->faulty_ticks += count(faulty), s->missed += count(faulty & ~alarm);
    s->sum_q += qq, s->sum_w += ww, s->sum_u += uu;
    s->faulty_q += kept(faulty, qq), s->faulty_w += kept(faulty, ww), s->faulty_u += kept(faulty, uu);
    s->peak_q = pick(start, s->peak_q, largest(s->peak_q, qq)); /* squares; the root is taken at the end */
    s->peak_w = pick(start, s->peak_w, largest(s->peak_w, ww));
    s->peak_u = largest(s->peak_u, uu);
    s->end = pick(before, t, s->end);
    s->outside = pick(before & (qq > (REAL)(BAND * BAND)), t, s->outside);
    V log = qq + ww + uu + xi + z->k_w + (x.q.x + x.q.y + x.q.z + x.w.x + x.w.y + x.w.z);
    s->ok &= size(log) < INFINITY;
    l->x = x;
}

INLINE void values(const Tally *s, long ticks, long n, REAL *out) {
    V all_ticks = all(ticks), settled = pick(s->outside == s->end, all(INFINITY), largest(s->outside, all(0)));
    V value[SCORES] = {
        s->delay,
        mean(s->start_alarms, s->start_ticks),
        mean(s->false_alarms, s->false_ticks),
        mean(s->missed, s->faulty_ticks),
        root(mean(s->sum_q, all_ticks)),
        root(mean(s->sum_w, all_ticks)),
        root(mean(s->faulty_q, s->faulty_ticks)),
        root(mean(s->faulty_w, s->faulty_ticks)),
        pick(s->peak_q < 0, all(NAN), root(s->peak_q)),
        pick(s->peak_w < 0, all(NAN), root(s->peak_w)),
        pick(s->end < 0, all(NAN), settled),
        root(mean(s->sum_u, all_ticks)),
        root(mean(s->faulty_u, s->faulty_ticks)),
        pick(s->peak_u < 0, all(NAN), root(s->peak_u)),
        count(s->ok),
    };
    for (int i = 0; i < SCORES; i++) memcpy(out + i * n, &value[i], sizeof(V));
}

/* normals: NULL, or those of these lanes, (ticks, 6, n); drawn: draw them */
INLINE void run(int side, const Params *params, const REAL *scenario, const REAL *normals, int drawn, uint64_t seed,
                long n, long ticks, int substeps, REAL dt, REAL *out) {
    Loop l[2];
    for (int j = 0; j < side; j++) begin(&l[j], params, scenario + j * LANES, seed + j, n, substeps, dt);
    for (long k = 0; k < ticks; k++) {
        for (int j = 0; j < side; j++) tick(&l[j], params, normals ? normals + j * LANES : 0, drawn, k, dt, n);
        for (int i = 0; i < substeps; i++) {
            rk4(l, side);
            for (int j = 0; j < (i + 1 < substeps ? side : 0); j++) l[j].seen = see(&l[j].c, &l[j].z, l[j].x);
        }
    }
    for (int j = 0; j < side; j++) values(&l[j].s, ticks, n, out + j * LANES);
}

#define RUN(side, normals, drawn) \
    run(side, params, scenario + i, normals, drawn, seed * 0x2545f4914f6cdd1du + i, n, ticks, substeps, dt, out + i)

/* n scenarios, a multiple of lanes(); params (23), scenario (77, n): leaves of the system's trees in their order;
   noise: 0 none, 1 drawn here, 2 given in normals (ticks, 6, n); out (15, n): Scores */
void observer_pd(const REAL *numbers, const REAL *scenario, const REAL *normals, int noise, uint64_t seed, long n,
                 long ticks, int substeps, double dt, REAL *out) {
    const Params *params = (const Params *)numbers;
#ifdef __SSE__
    unsigned int csr = _mm_getcsr();
    _mm_setcsr(csr | 0x8040); /* numbers too small to be normal are zero, as XLA has it */
#endif
    for (long i = 0; i < n; i += 2 * LANES) {
        if (n - i == LANES) {
            if (noise == 0) RUN(1, 0, 0);
            if (noise == 1) RUN(1, 0, 1);
            if (noise == 2) RUN(1, normals + i, 0);
        } else {
            if (noise == 0) RUN(2, 0, 0);
            if (noise == 1) RUN(2, 0, 1);
            if (noise == 2) RUN(2, normals + i, 0);
        }
    }
#ifdef __SSE__
    _mm_setcsr(csr);
#endif
}

int lanes(void) { return LANES; }
