// One tick of the 17-state filter of Park (2005) for many scenarios: joint RK4 of mean and covariance with the
// Jacobian at every stage, trigonometry included, then 11 scalar measurements one after the other. Only the upper
// triangle of the covariance is kept up; products use the sparsity of the Jacobian by hand. LANES scenarios side by
// side in vector registers.
#include <math.h>
#include <string.h>

#define LANES (64 / (int)sizeof(REAL))
#define N 17
#define M 11
#define MOVING 9
typedef REAL V __attribute__((vector_size(64)));
#define SIN(a) (sizeof(REAL) == 4 ? sinf(a) : sin(a))
#define COS(a) (sizeof(REAL) == 4 ? cosf(a) : cos(a))
#define T (N * (N + 1) / 2)
#define ROW(i) ((i) * (2 * N - 1 - (i)) / 2)  // start of row i of the packed triangle, less i
#define AT(P, i, j) P[(i) < (j) ? ROW(i) + (j) : ROW(j) + (i)]

typedef struct {
    REAL J[9], J_inv[9], G[12], W[12], Q[N], R[M], dt;
} Model;

// two functions, lest the compiler joins sine and cosine to sincos, of which there is no vector version
static __attribute__((noinline)) void all_sines(const REAL *restrict in, REAL *restrict out) {
    for (int l = 0; l < 2 * LANES; l++) out[l] = SIN(in[l]);
}

static __attribute__((noinline)) void all_cosines(const REAL *restrict in, REAL *restrict out) {
    for (int l = 0; l < 2 * LANES; l++) out[l] = COS(in[l]);
}

// rates of the moving states, and the 9 x 10 block of A by angles, body rate and wheels (columns 3 .. 12)
static inline void dynamics(const Model *m, const V *x, const V *u, V *k, V A[MOVING][10]) {
    REAL in[2 * LANES], sines[2 * LANES], cosines[2 * LANES];
    memcpy(in, x + 3, sizeof in);
    all_sines(in, sines);
    all_cosines(in, cosines);
    V sine[2], cosine[2];
    memcpy(sine, sines, sizeof sine);
    memcpy(cosine, cosines, sizeof cosine);
    V s = sine[0], c = cosine[0], sec = 1 / cosine[1], t = sine[1] * sec;
    const V *w = x + 6;
    V q = w[1] * s + w[2] * c, p = w[1] * c - w[2] * s;
    for (int i = 0; i < 3; i++) k[i] = x[3 + i];
    k[3] = w[0] + t * q;
    k[4] = p;
    k[5] = q * sec;
    V L[3], H[3];
    for (int i = 0; i < 3; i++) {
        L[i] = m->J[3 * i] * w[0] + m->J[3 * i + 1] * w[1] + m->J[3 * i + 2] * w[2];
        H[i] = (V){0};
        for (int j = 0; j < 4; j++) {
            L[i] += m->W[4 * i + j] * x[9 + j];
            H[i] += m->W[4 * i + j] * u[j];
        }
    }
    V r[3] = {-H[0] - (w[1] * L[2] - w[2] * L[1]), -H[1] - (w[2] * L[0] - w[0] * L[2]), -H[2] - (w[0] * L[1] - w[1] * L[0])};
    for (int i = 0; i < 3; i++)
        k[6 + i] = m->J_inv[3 * i] * r[0] + m->J_inv[3 * i + 1] * r[1] + m->J_inv[3 * i + 2] * r[2];
    // angles
    A[3][0] = t * p;
    A[3][1] = q * sec * sec;
    A[3][4] = t * s;
    A[3][5] = t * c;
    A[4][0] = -q;
    A[4][4] = c;
    A[4][5] = -s;
    A[5][0] = p * sec;
    A[5][1] = q * t * sec;
    A[5][4] = s * sec;
    A[5][5] = c * sec;
    // body rate: J^-1 ([L]x - [w]x J) by w, -J^-1 [w]x W by h
    V B[3][7];
    for (int j = 0; j < 7; j++) {
        REAL v0 = j < 3 ? m->J[j] : m->W[j - 3], v1 = j < 3 ? m->J[3 + j] : m->W[4 + j - 3],
             v2 = j < 3 ? m->J[6 + j] : m->W[8 + j - 3];
        B[0][j] = -(w[1] * v2 - w[2] * v1);
        B[1][j] = -(w[2] * v0 - w[0] * v2);
        B[2][j] = -(w[0] * v1 - w[1] * v0);
    }
    B[0][1] -= L[2];
    B[0][2] += L[1];
    B[1][0] += L[2];
    B[1][2] -= L[0];
    B[2][0] -= L[1];
    B[2][1] += L[0];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 7; j++)
            A[6 + i][3 + j] = m->J_inv[3 * i] * B[0][j] + m->J_inv[3 * i + 1] * B[1][j] + m->J_inv[3 * i + 2] * B[2][j];
}

// a stage: K = A Ps + Ps A' + Q, of which only the first 9 rows of A Ps are not zero; Pn += add K, Ps = P + ahead K
static inline void covariance_stage(const Model *m, V A[MOVING][10], const V P[T], V Ps[T], V Pn[T], REAL add, REAL ahead) {
    V AP[N][MOVING];  // transposed
#pragma GCC unroll 17
    for (int j = 0; j < N; j++) {
        V p[13];
#pragma GCC unroll 13
        for (int i = 3; i < 13; i++) p[i] = AT(Ps, i, j);
        for (int i = 0; i < 3; i++) AP[j][i] = p[3 + i];
        AP[j][3] = A[3][0] * p[3] + A[3][1] * p[4] + p[6] + A[3][4] * p[7] + A[3][5] * p[8];
        AP[j][4] = A[4][0] * p[3] + A[4][4] * p[7] + A[4][5] * p[8];
        AP[j][5] = A[5][0] * p[3] + A[5][1] * p[4] + A[5][4] * p[7] + A[5][5] * p[8];
        for (int i = 6; i < 9; i++) {
            V a = A[i][3] * p[6];
            for (int n = 4; n < 10; n++) a += A[i][n] * p[3 + n];
            AP[j][i] = a;
        }
    }
#pragma GCC unroll 17
    for (int i = 0; i < N; i++)
#pragma GCC unroll 17
        for (int j = i; j < N; j++) {
            V k = {0};
            if (i < MOVING) k += AP[j][i];
            if (j < MOVING) k += AP[i][j];
            if (i == j) k += m->Q[i];
            AT(Pn, i, j) += add * k;
            AT(Ps, i, j) = AT(P, i, j) + ahead * k;
        }
}

static void tick(const Model *m, V *x, V P[T], const V *u, const V *y) {
    static const REAL ahead[4] = {0.5, 0.5, 1, 0}, weight[4] = {1. / 6, 1. / 3, 1. / 3, 1. / 6};
    V k[N], xs[N], Ps[T], xn[N], Pn[T], A[MOVING][10];
    memcpy(xs, x, sizeof xs);
    memcpy(xn, x, sizeof xn);
    memcpy(Ps, P, sizeof Ps);
    memcpy(Pn, P, sizeof Pn);
    for (int i = 0; i < 4; i++) k[9 + i] = u[i], k[13 + i] = (V){0};
    for (int s = 0; s < 4; s++) {
        dynamics(m, xs, u, k, A);
        covariance_stage(m, A, P, Ps, Pn, m->dt * weight[s], m->dt * ahead[s]);
        for (int i = 0; i < N; i++) {
            xn[i] += m->dt * weight[s] * k[i];
            xs[i] = x[i] + m->dt * ahead[s] * k[i];
        }
    }
    for (int r = 0; r < M; r++) {
        V g[N], S, nu;
        int gyro = r >= 3 && r < 7, b = r + 10, direct = r < 3 ? 3 + r : r + 2;  // y: angle, gyro, wheel
        if (gyro) {
            const REAL *a = m->G + 3 * (r - 3);
            for (int j = 0; j < N; j++) g[j] = a[0] * AT(Pn, 6, j) + a[1] * AT(Pn, 7, j) + a[2] * AT(Pn, 8, j) + AT(Pn, b, j);
            S = a[0] * g[6] + a[1] * g[7] + a[2] * g[8] + g[b] + m->R[r];
            nu = y[r] - (a[0] * xn[6] + a[1] * xn[7] + a[2] * xn[8] + xn[b]);
        } else {
            for (int j = 0; j < N; j++) g[j] = AT(Pn, direct, j);
            S = g[direct] + m->R[r];
            nu = y[r] - xn[direct];
        }
        V inverse = 1 / S, gain[N];
        for (int j = 0; j < N; j++) gain[j] = g[j] * inverse;
        for (int j = 0; j < N; j++) xn[j] += gain[j] * nu;
#pragma GCC unroll 17
        for (int i = 0; i < N; i++)
#pragma GCC unroll 17
            for (int j = i; j < N; j++) AT(Pn, i, j) -= gain[i] * g[j];
    }
    memcpy(x, xn, sizeof xn);
    memcpy(P, Pn, sizeof Pn);
}

// mean (n / LANES, 17, LANES), cov (n / LANES, 17, 17, LANES), both overwritten; u (4) and y (11) as the mean
void run(const Model *m, int n, int ticks, REAL *mean, REAL *cov, const REAL *u, const REAL *y) {
    for (int block = 0; block < n / LANES; block++) {
        V x[N], full[N][N], P[T], ub[4], yb[M];
        memcpy(x, mean + block * N * LANES, sizeof x);
        memcpy(full, cov + block * N * N * LANES, sizeof full);
        memcpy(ub, u + block * 4 * LANES, sizeof ub);
        memcpy(yb, y + block * M * LANES, sizeof yb);
        for (int i = 0; i < N; i++)
            for (int j = i; j < N; j++) AT(P, i, j) = full[i][j];
        for (int t = 0; t < ticks; t++) tick(m, x, P, ub, yb);
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) full[i][j] = AT(P, i, j);
        memcpy(mean + block * N * LANES, x, sizeof x);
        memcpy(cov + block * N * N * LANES, full, sizeof full);
    }
}
