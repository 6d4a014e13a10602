# ONNX Runtime from a release archive, a distribution's package or a pip wheel's library with headers of its own.
#
# ONNXRUNTIME_ROOT (variable or environment) names a folder with include/ and lib/; ONNXRUNTIME_INCLUDE_DIR and
# ONNXRUNTIME_LIBRARY its parts. Defines the target mgca::onnxruntime.

set(ONNXRUNTIME_ROOT "$ENV{ONNXRUNTIME_ROOT}" CACHE PATH "ONNX Runtime: folder with include/ and lib/")
find_path(ONNXRUNTIME_INCLUDE_DIR onnxruntime_cxx_api.h
  HINTS "${ONNXRUNTIME_ROOT}/include" PATH_SUFFIXES onnxruntime onnxruntime/core/session)
find_library(ONNXRUNTIME_LIBRARY NAMES onnxruntime libonnxruntime.so.1 HINTS "${ONNXRUNTIME_ROOT}/lib")
mark_as_advanced(ONNXRUNTIME_INCLUDE_DIR ONNXRUNTIME_LIBRARY)

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(MgcaOnnxRuntime REQUIRED_VARS ONNXRUNTIME_LIBRARY ONNXRUNTIME_INCLUDE_DIR)
if(MgcaOnnxRuntime_FOUND AND NOT TARGET mgca::onnxruntime)
  add_library(mgca::onnxruntime UNKNOWN IMPORTED)
  set_target_properties(mgca::onnxruntime PROPERTIES
    IMPORTED_LOCATION "${ONNXRUNTIME_LIBRARY}"
    INTERFACE_INCLUDE_DIRECTORIES "${ONNXRUNTIME_INCLUDE_DIR}")
endif()
