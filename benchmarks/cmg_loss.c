/* Grid count of Table 3 in plain C, the yardstick for jaxatt.singularity.ill_conditioned.

   For every combination of kept^3 gimbal angles: the condition number of T = [t1 t2 t3], unit columns, from the
   largest root of the characteristic cubic (Newton from above) and the product of the other two. */
#include <math.h>

#ifndef REAL
#define REAL double
#endif
#define NEWTON 7
#define MAX(a, b) ((a) > (b) ? (a) : (b)) /* unlike fmax, these vectorise whatever the compiler makes of NaN */
#define MIN(a, b) ((a) < (b) ? (a) : (b))

/* t: torque directions, [module][x, y, z][kept]; returns how many combinations have condition >= threshold */
long ill_conditioned(const REAL *t, int kept, REAL threshold)
{
    const REAL k2 = threshold * threshold;
    const REAL *x3 = t + 6 * kept, *y3 = x3 + kept, *z3 = y3 + kept;
    long total = 0;
    for (int i = 0; i < kept; i++) {
        const REAL x1 = t[i], y1 = t[kept + i], z1 = t[2 * kept + i];
        for (int j = 0; j < kept; j++) {
            const REAL *second = t + 3 * kept;
            const REAL x2 = second[j], y2 = second[kept + j], z2 = second[2 * kept + j];
            const REAL a = x1 * x2 + y1 * y2 + z1 * z2;
            const REAL nx = y1 * z2 - z1 * y2, ny = z1 * x2 - x1 * z2, nz = x1 * y2 - y1 * x2;
            int row = 0;
            for (int k = 0; k < kept; k++) {
                const REAL b = x1 * x3[k] + y1 * y3[k] + z1 * z3[k];
                const REAL c = x2 * x3[k] + y2 * y3[k] + z2 * z3[k];
                const REAL d = nx * x3[k] + ny * y3[k] + nz * z3[k];
                const REAL s = a * a + b * b + c * c;
                /* roots of m^3 - s m - 2abc with m = l - 1; the largest is at most 2 sqrt(s/3) */
                REAL m = 2 * sqrt(s / 3);
                for (int it = 0; it < NEWTON; it++) {
                    const REAL slope = 3 * m * m - s;
                    m -= (m * (m * m - s) - 2 * a * b * c) / MAX(slope, (REAL)1e-30);
                }
                const REAL l1 = 1 + m;
                const REAL both = MAX(3 - l1, 0), f = d * d / l1;
                const REAL divisor = both + sqrt(MAX(both * both - 4 * f, 0));
                const REAL l3 = MIN(2 * f / MAX(divisor, (REAL)1e-30), both / 2);
                row += l1 >= k2 * l3;
            }
            total += row;
        }
    }
    return total;
}
