/* Runs recorded steps on a Cortex-M: results, instructions and stack go into a file of the host.
 *
 * -DPROJECT="tank.h" -DNAME=tank -DTIMED=64, records.bin in the folder of the compiler: the state
 * and the inputs of one step after the other, as numbers of the project. The file holds `report`
 * and, record by record, outputs, status and state. */
#include PROJECT

#include <stdint.h>
#include <string.h>

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(part) JOIN(NAME, part)

typedef OF(_real_t) number_t;
typedef OF(_state_t) state_t;
typedef OF(_in_t) in_t;
typedef OF(_out_t) out_t;
typedef int step_t(state_t *, const in_t *, out_t *);
#ifdef SELFTEST
int OF(_selftest)(void);
#endif
typedef struct {
    state_t state;
    in_t in;
} record_t;

__asm__(".section .rodata.records\n.balign 8\n.global records, records_end\n"
        "records:\n.incbin \"records.bin\"\nrecords_end:\n.previous\n");
extern const record_t records[], records_end[];
extern uint32_t stack_low[], stack_top[];

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define SYSTICK_CONTROL REGISTER(0xe000e010u)
#define SYSTICK_RELOAD REGISTER(0xe000e014u)
#define SYSTICK_VALUE REGISTER(0xe000e018u)
#define CPACR REGISTER(0xe000ed88u)
#define PAINT 0xa5c3f00du

static struct {
    uint32_t loop, nothing, step; /* ticks of 40 instructions: 100,000 turns, no step, steps */
    uint32_t stack;               /* bytes below the caller */
    uint32_t fpscr;               /* modes that were set, before or after */
    uint32_t selftest;            /* the first step of it that differs */
} report;
static state_t state;
static in_t in;
static out_t out;

static int host(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;

    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void leave(uint32_t code)
{
    const uint32_t argument[] = {0x20026u, code};

    (void)host(0x20, argument);
    for (;;) {
    }
}

static void fault(void)
{
    leave(3u);
}

/* Flush to zero, default NaN, rounding: none may be set. */
static uint32_t modes(void)
{
    uint32_t value = 0u;
#ifdef __ARM_FP
    __asm__ volatile("vmrs %0, fpscr" : "=r"(value));
#endif
    return value & 0x03c00000u;
}

static int nothing(state_t *s, const in_t *i, out_t *o)
{
    (void)s;
    (void)i;
    (void)o;
    return 0;
}

__attribute__((noinline)) static uint32_t timed(step_t *step)
{
    uint32_t before = SYSTICK_VALUE;
    int i;

    for (i = 0; i < TIMED; ++i) {
        state = records[i].state;
        in = records[i].in;
        (void)step(&state, &in, &out);
    }
    return (before - SYSTICK_VALUE) & 0xffffffu;
}

static uint32_t known_loop(void)
{
    uint32_t before = SYSTICK_VALUE;
    uint32_t turns = 100000u;

    __asm__ volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(turns) : : "cc");
    return (before - SYSTICK_VALUE) & 0xffffffu;
}

__attribute__((noinline)) static uint32_t stack_of(step_t *step)
{
    uint32_t *sp, *at;

    __asm__ volatile("mov %0, sp" : "=r"(sp));
    for (at = stack_low; at < sp; ++at) {
        *(volatile uint32_t *)at = PAINT;
    }
    state = records[0].state;
    in = records[0].in;
    (void)step(&state, &in, &out);
    for (at = stack_low; *at == PAINT; ++at) {
    }
    return (uint32_t)(sp - at) * 4u;
}

static void write(uint32_t file, const void *data, uint32_t size)
{
    const uint32_t argument[] = {file, (uint32_t)(uintptr_t)data, size};

    if (host(0x05, argument) != 0) {
        leave(4u);
    }
}

static void reset(void)
{
    static const char name[] = "results.bin";
    const uint32_t open[] = {(uint32_t)(uintptr_t)name, 5u, sizeof name - 1u};
    const record_t *record;
    uint32_t file;

#ifdef __ARM_FP
    CPACR |= 0xf00000u;
    __asm__ volatile("dsb\n isb");
#endif
    SYSTICK_RELOAD = 0xffffffu;
    SYSTICK_VALUE = 0u;
    SYSTICK_CONTROL = 5u;
    report.fpscr = modes();
    report.stack = stack_of(OF(_step));
    report.loop = known_loop();
    (void)SYSTICK_CONTROL; /* clears the mark of an overflow */
    report.nothing = timed(nothing);
    report.step = timed(OF(_step));
    if ((SYSTICK_CONTROL & 0x10000u) != 0u) {
        leave(5u);
    }
    file = (uint32_t)host(0x01, open);
#ifdef SELFTEST
    report.selftest = (uint32_t)OF(_selftest)();
#endif
    report.fpscr |= modes();
    write(file, &report, sizeof report);
    for (record = records; record < records_end; ++record) {
        number_t status;

        state = record->state;
        in = record->in;
        status = (number_t)OF(_step)(&state, &in, &out);
        write(file, &out, sizeof out);
        write(file, &status, sizeof status);
        write(file, &state, sizeof state);
    }
    leave(modes() == 0u ? 0u : 6u);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    stack_top, (void *)reset, (void *)fault, (void *)fault,
    (void *)fault, (void *)fault, (void *)fault};
