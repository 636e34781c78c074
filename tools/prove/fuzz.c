/* Three steps from a memory and inputs of any bits, held to what the status promises. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "NAME.c"

#define STEPS 3
#define REQUIRE(condition) \
    do { \
        if (!(condition)) { \
            abort(); \
        } \
    } while (0)

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void ordered(const NAME_real_t *lower, const NAME_real_t *upper, unsigned count)
{
    for (unsigned i = 0u; i < count; ++i) {
        REQUIRE(lower[i] <= upper[i]);
    }
}

static int finite(const NAME_real_t *values, unsigned count)
{
    for (unsigned i = 0u; i < count; ++i) {
        if (!(fabs(values[i]) <= FINITE)) {
            return 0;
        }
    }
    return 1;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    NAME_state_t state;
    NAME_in_t in;
    NAME_out_t out;
    NAME_real_t memory[sizeof state / sizeof(NAME_real_t)];

    if (size < sizeof memory + STEPS * sizeof in) {
        return 0;
    }
    memcpy(memory, data, sizeof memory);
    NAME_set_memory(&state, memory);
    for (unsigned k = 0u; k < STEPS; ++k) {
        const int known = state.initialised > 0.5 && state.initialised < 1.5;
        int status;
        int sound;

        memcpy(&in, data + sizeof memory + k * sizeof in, sizeof in);
        status = NAME_step(&state, &in, &out);
        REQUIRE(status >= 0 && status <= 127);
        REQUIRE(((status & 1) != 0) == !known);
        sound = 1;
KNOWN
        REQUIRE(((status & 2) != 0) == !sound);
        REQUIRE(finite(in.y, sizeof in.y / sizeof *in.y) || (status & 32) != 0);
        ordered(out.x_lower, out.x_upper, sizeof out.x_lower / sizeof *out.x_lower);
        for (unsigned i = 0u; status == 0 && i < sizeof out.xhat / sizeof *out.xhat; ++i) {
            REQUIRE(out.xhat[i] == out.xhat[i]);
        }
FAULTS
    }
    return 0;
}
