// The model files within the library: cmake/MgcaEmbedModel.cmake. The assembler copies their bytes, which takes no time.

#include "embedded_model.hpp"

#ifdef MGCA_EMBEDDED_FILE

#if defined(__APPLE__)
#define MGCA_READ_ONLY ".const_data\n"
#define MGCA_SYMBOL(name) "_" name
#define MGCA_HIDDEN(name) ".private_extern " MGCA_SYMBOL(name) "\n"
#define MGCA_BACK ".text\n"
#elif defined(_WIN32)
#define MGCA_READ_ONLY ".section .rdata,\"dr\"\n"
#if defined(__i386__)
#define MGCA_SYMBOL(name) "_" name
#else
#define MGCA_SYMBOL(name) name
#endif
#define MGCA_HIDDEN(name)
#define MGCA_BACK ".text\n"
#else
#define MGCA_READ_ONLY ".pushsection .rodata,\"a\",%progbits\n"
#define MGCA_SYMBOL(name) name
#define MGCA_HIDDEN(name) ".hidden " name "\n"
#define MGCA_BACK ".popsection\n"
#endif

#define MGCA_GLOBAL(name) ".globl " MGCA_SYMBOL(name) "\n" MGCA_HIDDEN(name)

#if defined(__GNUC__) && !defined(_WIN32)
#define MGCA_LOCAL __attribute__((visibility("hidden")))
#else
#define MGCA_LOCAL
#endif

// Global within the library, so that link-time optimisation finds them from another unit.
#define MGCA_EMBED(name, file)                              \
    __asm__(MGCA_READ_ONLY                                  \
            MGCA_GLOBAL(#name "_begin")                     \
            MGCA_GLOBAL(#name "_end")                       \
            ".balign 64\n"                                  \
            MGCA_SYMBOL(#name "_begin") ":\n"               \
            ".incbin \"" file "\"\n"                        \
            MGCA_SYMBOL(#name "_end") ":\n"                 \
            ".byte 0\n"                                     \
            MGCA_BACK);                                     \
    extern "C" const char name##_begin[] MGCA_LOCAL;        \
    extern "C" const char name##_end[] MGCA_LOCAL;          \
    static std::string_view name() { return {name##_begin, static_cast<std::size_t>(name##_end - name##_begin)}; }

MGCA_EMBED(mgca_embedded_model, MGCA_EMBEDDED_FILE)
#ifdef MGCA_EMBEDDED_FIRST_LOOK_FILE
MGCA_EMBED(mgca_embedded_first_look, MGCA_EMBEDDED_FIRST_LOOK_FILE)
#endif
#endif

namespace mgca::detail {

std::string_view embedded_model() {
#ifdef MGCA_EMBEDDED_FILE
    return mgca_embedded_model();
#else
    return {};
#endif
}

std::string_view embedded_first_look() {
#if defined(MGCA_EMBEDDED_FILE) && defined(MGCA_EMBEDDED_FIRST_LOOK_FILE)
    return mgca_embedded_first_look();
#else
    return {};
#endif
}

}  // namespace mgca::detail
