/* Prints the nanoseconds of a step: the least mean of many passes over records.bin. */
#define _POSIX_C_SOURCE 199309L
#include PROJECT

#include <stdio.h>
#include <time.h>

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(part) JOIN(NAME, part)
#define MOST 1024

static struct {
    OF(_state_t) state;
    OF(_in_t) in;
} records[MOST];

int main(void)
{
    FILE *file = fopen("records.bin", "rb");
    size_t count = file == NULL ? 0u : fread(records, sizeof records[0], MOST, file);
    double least = 1e300;
    int pass;

    for (pass = 0; pass < 3000 && count > 0u; ++pass) {
        struct timespec begin, end;
        OF(_state_t) state;
        OF(_out_t) out;
        size_t i;
        double taken;

        clock_gettime(CLOCK_MONOTONIC, &begin);
        for (i = 0; i < count; ++i) {
            state = records[i].state;
            (void)OF(_step)(&state, &records[i].in, &out);
        }
        clock_gettime(CLOCK_MONOTONIC, &end);
        taken = 1e9 * (double)(end.tv_sec - begin.tv_sec) + (double)(end.tv_nsec - begin.tv_nsec);
        least = taken < least ? taken : least;
    }
    printf("%.2f\n", least / (double)count);
    return count == 0u;
}
