/* One instant of the four tanks; the makefile or the command line says -DSINGLE. */
#ifndef BY_HAND_CORE_H
#define BY_HAND_CORE_H

#ifdef SINGLE
typedef float real;
#else
typedef double real;
#endif

typedef struct {
    real p[6]; /* predicted levels and faults */
    real s[4]; /* what the half widths are made of */
} by_hand_memory_t;

typedef struct {
    real u[2], y[3];
} by_hand_in_t;

typedef struct {
    real hat[6], lower[6], upper[6];
} by_hand_out_t;

/* Returns 1 where the next memory keeps the guarantee. */
int by_hand_step(by_hand_memory_t *m, const by_hand_in_t *in, by_hand_out_t *out);

#endif
