# The models within the library, for mgca::embedded_model(): MGCA_EMBED_MODEL, MGCA_MODEL_FILE, MGCA_FIRST_LOOK_FILE.

set(MGCA_MODEL_FILE "${CMAKE_CURRENT_SOURCE_DIR}/../mgca_filter/models/mgca_small.onnx" CACHE FILEPATH
  "Model file that MGCA_EMBED_MODEL puts into the library")
set(MGCA_FIRST_LOOK_FILE "${CMAKE_CURRENT_SOURCE_DIR}/../mgca_filter/models/mgca_fast.onnx" CACHE FILEPATH
  "Model file of a quicker network that is asked before it, likewise; empty = none")
if(NOT MGCA_EMBED_MODEL)
  return()
endif()

# The real path of a model file that is there, is the one that the sums beside the shipped models list (a user's own model
# is not listed), and is read again when it changes.
function(mgca_check_model option path)
  set(file "${${option}}")
  if(NOT EXISTS "${file}")
    message(FATAL_ERROR "MGCA_EMBED_MODEL: ${file} is not there; -D${option}=... names a model file")
  endif()
  get_filename_component(real "${file}" REALPATH)
  get_filename_component(folder "${file}" DIRECTORY)
  get_filename_component(name "${file}" NAME)
  if(EXISTS "${folder}/SHA256SUMS")
    file(STRINGS "${folder}/SHA256SUMS" sums)
    file(SHA256 "${real}" digest)
    foreach(line IN LISTS sums)
      if(line MATCHES "^([0-9a-f]+)  (.*)$" AND CMAKE_MATCH_2 STREQUAL name AND NOT CMAKE_MATCH_1 STREQUAL digest)
        message(FATAL_ERROR
          "MGCA_EMBED_MODEL: ${file} is damaged or replaced, its SHA-256 is not the one in SHA256SUMS")
      endif()
    endforeach()
    set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS "${folder}/SHA256SUMS" "${real}")
  endif()
  set(${path} "${real}" PARENT_SCOPE)
endfunction()

mgca_check_model(MGCA_MODEL_FILE MGCA_MODEL_PATH)
set(MGCA_EMBEDDED_PATHS "${MGCA_MODEL_PATH}")
set(MGCA_EMBEDDED_DEFINITIONS "MGCA_EMBEDDED_FILE=\"${MGCA_MODEL_PATH}\"")
if(MGCA_FIRST_LOOK_FILE)
  mgca_check_model(MGCA_FIRST_LOOK_FILE MGCA_FIRST_LOOK_PATH)
  if(NOT MGCA_FIRST_LOOK_PATH STREQUAL MGCA_MODEL_PATH)  # else the quick one is all that is wanted
    list(APPEND MGCA_EMBEDDED_PATHS "${MGCA_FIRST_LOOK_PATH}")
    list(APPEND MGCA_EMBEDDED_DEFINITIONS "MGCA_EMBEDDED_FIRST_LOOK_FILE=\"${MGCA_FIRST_LOOK_PATH}\"")
  endif()
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
  COMPILE_DEFINITIONS "${MGCA_EMBEDDED_DEFINITIONS}"
  COMPILE_OPTIONS -fno-lto
  OBJECT_DEPENDS "${MGCA_EMBEDDED_PATHS}")
