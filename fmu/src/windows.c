/* What a library for Windows takes from the C runtime's static part, so that it is linked with the
   system's UCRT alone: zig then need not build that part, which takes a minute on a new machine. */
#include <stdarg.h>
#include <stddef.h>

int _fltused = 0; /* asked for by code that uses floating point */

int __stdcall DllMainCRTStartup(void *library, unsigned reason, void *reserved);
int __stdcall DllMainCRTStartup(void *library, unsigned reason, void *reserved) {
    (void)library, (void)reason, (void)reserved;
    return 1;
}

/* ---- text: the UCRT has one function for the whole family; 2 asks for C99's return value ---- */

int __stdio_common_vsprintf(unsigned long long options, char *text, size_t size, const char *format,
                            void *locale, va_list arguments);

int vsnprintf(char *text, size_t size, const char *format, va_list arguments) {
    return __stdio_common_vsprintf(2, text, size, format, NULL, arguments);
}

int snprintf(char *text, size_t size, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    int length = vsnprintf(text, size, format, arguments);
    va_end(arguments);
    return length;
}

/* ---- memory: these must not be turned into calls of themselves ---- */

__attribute__((no_builtin)) void *memcpy(void *to, const void *from, size_t size) {
    for (size_t i = 0; i < size; i++) ((char *)to)[i] = ((const char *)from)[i];
    return to;
}

__attribute__((no_builtin)) void *memset(void *to, int value, size_t size) {
    for (size_t i = 0; i < size; i++) ((char *)to)[i] = (char)value;
    return to;
}

__attribute__((no_builtin)) int memcmp(const void *one, const void *other, size_t size) {
    const unsigned char *a = one, *b = other;
    for (size_t i = 0; i < size; i++)
        if (a[i] != b[i]) return a[i] < b[i] ? -1 : 1;
    return 0;
}

/* ---- stack: a frame of more than a page must touch its pages in order ---- */

#if defined(__x86_64__) /* size in rax */
__asm__(".globl ___chkstk_ms\n"
        "___chkstk_ms:\n"
        "  pushq %rcx\n"
        "  pushq %rax\n"
        "  leaq 24(%rsp), %rcx\n" /* the stack pointer of the caller */
        "1: cmpq $4096, %rax\n"
        "  jb 2f\n"
        "  subq $4096, %rcx\n"
        "  orb $0, (%rcx)\n"
        "  subq $4096, %rax\n"
        "  jmp 1b\n"
        "2: subq %rax, %rcx\n"
        "  orb $0, (%rcx)\n"
        "  popq %rax\n"
        "  popq %rcx\n"
        "  ret\n");
#elif defined(__i386__) /* size in eax; moves the stack pointer, too */
__asm__(".globl __alloca\n"
        "__alloca:\n"
        "  pushl %ecx\n"
        "  leal 8(%esp), %ecx\n" /* the stack pointer of the caller */
        "1: cmpl $4096, %eax\n"
        "  jb 2f\n"
        "  subl $4096, %ecx\n"
        "  orb $0, (%ecx)\n"
        "  subl $4096, %eax\n"
        "  jmp 1b\n"
        "2: subl %eax, %ecx\n"
        "  orb $0, (%ecx)\n"
        "  movl %esp, %eax\n"
        "  movl %ecx, %esp\n"
        "  movl (%eax), %ecx\n"
        "  jmpl *4(%eax)\n");
#elif defined(__aarch64__) /* a sixteenth of the size in x15 */
__asm__(".globl __chkstk\n"
        "__chkstk:\n"
        "  lsl x16, x15, #4\n"
        "  mov x17, sp\n"
        "1: cmp x16, #1, lsl #12\n"
        "  b.lo 2f\n"
        "  sub x17, x17, #1, lsl #12\n"
        "  ldr xzr, [x17]\n"
        "  sub x16, x16, #1, lsl #12\n"
        "  b 1b\n"
        "2: sub x17, x17, x16\n"
        "  ldr xzr, [x17]\n"
        "  ret\n");
#endif
