// The model file within the library: cmake/MgcaEmbedModel.cmake. The assembler copies its bytes, which takes no time.

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

// Global within the library, so that link-time optimisation finds them from another unit.
__asm__(MGCA_READ_ONLY
        MGCA_GLOBAL("mgca_embedded_model_begin")
        MGCA_GLOBAL("mgca_embedded_model_end")
        ".balign 64\n"
        MGCA_SYMBOL("mgca_embedded_model_begin") ":\n"
        ".incbin \"" MGCA_EMBEDDED_FILE "\"\n"
        MGCA_SYMBOL("mgca_embedded_model_end") ":\n"
        ".byte 0\n"
        MGCA_BACK);

#if defined(__GNUC__) && !defined(_WIN32)
#define MGCA_LOCAL __attribute__((visibility("hidden")))
#else
#define MGCA_LOCAL
#endif
extern "C" {
extern const char mgca_embedded_model_begin[] MGCA_LOCAL;
extern const char mgca_embedded_model_end[] MGCA_LOCAL;
}

namespace mgca::detail {

std::string_view embedded_model() {
    return {mgca_embedded_model_begin,
            static_cast<std::size_t>(mgca_embedded_model_end - mgca_embedded_model_begin)};
}

}  // namespace mgca::detail

#else

namespace mgca::detail {

std::string_view embedded_model() { return {}; }

}  // namespace mgca::detail

#endif
