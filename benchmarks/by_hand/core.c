/* The core of the four-tank step with peak bounds, by hand: correction, half widths around the
 * estimates, prediction. Frozen before the tape's writer was looked at; numbers.h comes from
 * benchmarks/embedded.py. States first (h1..h4), then faults (f1, f2). */
#include "core.h"

#include "numbers.h"

static int inside(const real v[6])
{
    int i;
    for (i = 0; i < 6; i++) {
        if (!(LIMITS[i][0] <= v[i] && v[i] <= LIMITS[i][1])) {
            return 0;
        }
    }
    return 1;
}

static real clip(real v, real low, real high)
{
    return v < low ? low : (v > high ? high : v);
}

int by_hand_step(by_hand_memory_t *m, const by_hand_in_t *in, by_hand_out_t *out)
{
    real *const p = m->p, *const s = m->s, *const c = out->hat;
    const real *const u = in->u;
    const real s0 = s[0], s1 = s[1], s2 = s[2], s3 = s[3];
    const real nu1 = in->y[0] - p[0], nu2 = in->y[1] - p[1];
    real in_box[4], beyond[4], flow[4];
    int i, sound;

    sound = inside(p);
    p[2] = in->y[2]; /* the third level is what is read */
    for (i = 0; i < 6; i++) {
        c[i] = p[i] + (Z[i][0] * nu1 + Z[i][1] * nu2);
    }
    sound = sound && LIMITS[2][0] <= p[2] && p[2] <= LIMITS[2][1] && inside(c);
    for (i = 0; i < 2; i++) {
        sound = sound && U_LIMITS[i][0] <= u[i] && u[i] <= U_LIMITS[i][1];
    }

    for (i = 0; i < 6; i++) {
        const real *const r = REACH[i];
        const real half = (r[0] * s0 + r[1] * s1 + r[2] * s2 + r[3] * s3) * ROUND_UP + ADD[i]
            + ULPS * FABS(c[i]);
        out->lower[i] = c[i] - half;
        out->upper[i] = c[i] + half;
    }
    for (i = 0; i < 4; i++) {
        const real *const d = DECAY[i];
        s[i] = d[0] * s0 + d[1] * s1 + d[2] * s2 + d[3] * s3;
    }

    for (i = 0; i < 4; i++) {
        in_box[i] = clip(c[i], BOX[i][0], BOX[i][1]);
        beyond[i] = c[i] - in_box[i];
        flow[i] = OUTFLOW[i] * SQRT(in_box[i]);
    }
    p[0] = PUMP1_H1 * c[4] - flow[0] + in_box[0] + flow[2] + PUMP1_H1 * u[0]
        + (SLOPE[0] * beyond[0] + SLOPE_13 * beyond[2]);
    p[1] = PUMP2_H2 * c[5] - flow[1] + in_box[1] + flow[3] + PUMP2_H2 * u[1]
        + (SLOPE[1] * beyond[1] + SLOPE_24 * beyond[3]);
    p[2] = ZERO; /* and is not predicted */
    p[3] = PUMP1_H4 * c[4] - flow[3] + in_box[3] + PUMP1_H4 * u[0] + SLOPE[3] * beyond[3];
    p[4] = c[4];
    p[5] = c[5];
    return sound;
}
