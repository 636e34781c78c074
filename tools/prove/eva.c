/* One step from any memory and any inputs, every bit pattern of a double, or those of a box. */
#include "__fc_builtin.h"
#include "NAME.c"

#define COUNT(type) (sizeof(type) / sizeof(NAME_real_t))

static volatile NAME_real_t any;

int main(void)
{
    NAME_state_t state;
    NAME_in_t in;
    NAME_out_t out;
    NAME_real_t memory[COUNT(NAME_state_t)];
    NAME_real_t given[COUNT(NAME_in_t)];
    NAME_real_t *inputs = (NAME_real_t *)&in;
    int status;

GIVEN
    for (unsigned i = 0u; i < COUNT(NAME_in_t); ++i) {
        inputs[i] = given[i];
    }
    NAME_set_memory(&state, memory);
    status = NAME_step(&state, &in, &out);
    /*@ assert status_is_a_mask: 0 <= status <= 127; */
    NAME_get_memory(&state, memory);
    /*@ assert results_are_written: \initialized(&out); */
    return 0;
}
