/* A bare Cortex-M7 (qemu's mps2-an500) runs main and prints by semihosting. */
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

int main(void);
extern uint32_t stack_top;

static int semihosting(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void put(char c) { (void)semihosting(3, &c); }

static void number(unsigned long value, unsigned base, int width, char fill) {
    char digits[12];
    int n = 0;
    do {
        digits[n++] = "0123456789abcdef"[value % base];
        value /= base;
    } while (value);
    while (n < width) digits[n++] = fill;
    while (n) put(digits[--n]);
}

/* Of printf what a self-test uses; numbers with a fraction are not told. */
int printf(const char *format, ...) {
    va_list list;
    va_start(list, format);
    for (; *format; ++format) {
        if (*format != '%') {
            put(*format);
            continue;
        }
        do ++format;
        while (*format == '.' || *format == 'l' || (*format >= '0' && *format <= '9'));
        if (*format == 'd') number((unsigned long)va_arg(list, int), 10, 1, '0');
        if (*format == 'x') number(va_arg(list, unsigned long), 16, 8, '0');
        if (*format == 'g') {
            (void)va_arg(list, double);
            put('~');
        }
        if (*format == 's') {
            const char *text = va_arg(list, const char *);
            while (*text) put(*text++);
        }
    }
    va_end(list);
    return 0;
}


void _start(void);
void _start(void) {
    struct {
        uint32_t reason, code;
    } end = {0x20026, 0};
    *(volatile uint32_t *)0xE000ED88 |= 0xF << 20; /* the floating-point unit on */
    __asm__ volatile("dsb; isb");
    end.code = (uint32_t)main();
    (void)semihosting(0x20, &end);
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const VECTORS[] = {&stack_top,
                                                                                 (void *)_start};
