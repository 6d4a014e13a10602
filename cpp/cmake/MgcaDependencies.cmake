# OpenCV's modules that the library needs, and the runtime of the network.
#
# No package that the tests could install brings OpenCV 5 with headers: MGCA_RUNTIME=opencv was compiled against the headers
# of its source archive, and is otherwise untested. ONNX Runtime is preferred where both are there.
#
# Sets MGCA_OPENCV_LIBRARIES, MGCA_OPENCV_COMPONENTS and MGCA_CHOSEN_RUNTIME (onnxruntime or opencv).

find_package(OpenCV REQUIRED COMPONENTS core)
if(OpenCV_VERSION VERSION_LESS 4.5.4)
  message(FATAL_ERROR "OpenCV ${OpenCV_VERSION} found in ${OpenCV_DIR}, 4.5.4 or newer is needed")
endif()
if(OpenCV_VERSION VERSION_LESS 5)
  set(MGCA_OPENCV_COMPONENTS core calib3d)
else()
  set(MGCA_OPENCV_COMPONENTS core geometry)
endif()

if(NOT MGCA_RUNTIME MATCHES "^(auto|onnxruntime|opencv)$")
  message(FATAL_ERROR "MGCA_RUNTIME: expected auto, onnxruntime or opencv, got ${MGCA_RUNTIME}")
endif()
set(MGCA_CHOSEN_RUNTIME "")
if(NOT MGCA_RUNTIME STREQUAL "opencv")
  find_package(MgcaOnnxRuntime QUIET)
  if(MgcaOnnxRuntime_FOUND)
    set(MGCA_CHOSEN_RUNTIME onnxruntime)
    message(STATUS "mgca runs on ONNX Runtime: ${ONNXRUNTIME_LIBRARY}")
  endif()
endif()
if(NOT MGCA_CHOSEN_RUNTIME AND NOT MGCA_RUNTIME STREQUAL "onnxruntime" AND OpenCV_VERSION VERSION_GREATER_EQUAL 5)
  set(MGCA_CHOSEN_RUNTIME opencv)
  list(APPEND MGCA_OPENCV_COMPONENTS dnn)
  message(STATUS "mgca runs on cv::dnn of OpenCV ${OpenCV_VERSION}, which its authors compiled and could not run")
endif()
if(NOT MGCA_CHOSEN_RUNTIME)
  message(FATAL_ERROR
    "No ONNX Runtime, and cv::dnn of OpenCV ${OpenCV_VERSION} cannot run the model or was not asked for (OpenCV 5 can). "
    "Give ONNX Runtime's folder with include/ and lib/ as -DONNXRUNTIME_ROOT=..., or its parts as "
    "-DONNXRUNTIME_INCLUDE_DIR=... and -DONNXRUNTIME_LIBRARY=...")
endif()
# Only what is needed: some of OpenCV's modules bring libraries that do not go along with ONNX Runtime.
find_package(OpenCV REQUIRED COMPONENTS ${MGCA_OPENCV_COMPONENTS})
set(MGCA_OPENCV_LIBRARIES ${MGCA_OPENCV_COMPONENTS})
list(TRANSFORM MGCA_OPENCV_LIBRARIES PREPEND opencv_)
