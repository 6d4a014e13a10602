# The model within the library, for mgca::embedded_model(): MGCA_EMBED_MODEL, MGCA_MODEL_FILE.

set(MGCA_MODEL_FILE "${CMAKE_CURRENT_SOURCE_DIR}/../mgca_filter/models/mgca_small.onnx" CACHE FILEPATH
  "Model file that MGCA_EMBED_MODEL puts into the library")
if(NOT MGCA_EMBED_MODEL)
  return()
endif()

if(NOT EXISTS "${MGCA_MODEL_FILE}")
  message(FATAL_ERROR "MGCA_EMBED_MODEL: ${MGCA_MODEL_FILE} is not there; -DMGCA_MODEL_FILE=... names a model file")
endif()
get_filename_component(MGCA_MODEL_PATH "${MGCA_MODEL_FILE}" REALPATH)

# The sums beside the shipped models; a user's own model is not listed.
get_filename_component(MGCA_MODEL_FOLDER "${MGCA_MODEL_FILE}" DIRECTORY)
get_filename_component(MGCA_MODEL_NAME "${MGCA_MODEL_FILE}" NAME)
if(EXISTS "${MGCA_MODEL_FOLDER}/SHA256SUMS")
  file(STRINGS "${MGCA_MODEL_FOLDER}/SHA256SUMS" MGCA_MODEL_SUMS)
  file(SHA256 "${MGCA_MODEL_PATH}" MGCA_MODEL_SHA256)
  foreach(line IN LISTS MGCA_MODEL_SUMS)
    if(line MATCHES "^([0-9a-f]+)  (.*)$" AND CMAKE_MATCH_2 STREQUAL MGCA_MODEL_NAME
        AND NOT CMAKE_MATCH_1 STREQUAL MGCA_MODEL_SHA256)
      message(FATAL_ERROR
        "MGCA_EMBED_MODEL: ${MGCA_MODEL_FILE} is damaged or replaced, its SHA-256 is not the one in SHA256SUMS")
    endif()
  endforeach()
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS "${MGCA_MODEL_FOLDER}/SHA256SUMS" "${MGCA_MODEL_PATH}")
endif()

# g++ and clang hand such a line to an assembler that knows .incbin; Microsoft's compiler has none.
include(CheckCXXSourceCompiles)
check_cxx_source_compiles(
  "__asm__(R\"(.incbin \"${CMAKE_CURRENT_SOURCE_DIR}/include/mgca/version.hpp\")\"); int main() { return 0; }"
  MGCA_HAS_INCBIN)
if(NOT MGCA_HAS_INCBIN)
  unset(MGCA_HAS_INCBIN CACHE)  # ask again with other flags
  message(FATAL_ERROR
    "MGCA_EMBED_MODEL: ${CMAKE_CXX_COMPILER} cannot put a file into a program (no .incbin; g++ and clang can). "
    "Use -DMGCA_EMBED_MODEL=OFF, and mgca::Model::from_file or from_memory.")
endif()
# Without link-time optimisation, which would read the file when a user's program is linked.
set_source_files_properties(src/embedded_model.cpp PROPERTIES
  COMPILE_DEFINITIONS "MGCA_EMBEDDED_FILE=\"${MGCA_MODEL_PATH}\""
  COMPILE_OPTIONS -fno-lto
  OBJECT_DEPENDS "${MGCA_MODEL_PATH}")
