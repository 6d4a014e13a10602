# Install what was built, and link programs of a user's own to it: by find_package, by pkg-config, by FetchContent.
#
# cmake -D BUILD=... -D CONFIG=... -D SOURCE=... -D MODEL=... -D FIRST_LOOK=... -D GENERATOR=... -D ROOT=... -D EMBEDDED=ON
#       -P test_install.cmake

set(WORK "${BUILD}/install_test")
file(REMOVE_RECURSE "${WORK}")
set(PREFIX "${WORK}/prefix")

function(run)
  execute_process(COMMAND ${ARGN} RESULT_VARIABLE code OUTPUT_VARIABLE out ERROR_VARIABLE out)
  if(NOT code EQUAL 0)
    string(REPLACE ";" " " command "${ARGN}")
    message(FATAL_ERROR "${command}\n${out}")
  endif()
  set(OUTPUT "${out}" PARENT_SCOPE)
endfunction()

run(${CMAKE_COMMAND} --install "${BUILD}" --prefix "${PREFIX}" --config "${CONFIG}")

# The environment that told the library's build where ONNX Runtime lies tells consumers nothing.
unset(ENV{ONNXRUNTIME_ROOT})
run(${CMAKE_COMMAND} -S "${SOURCE}/examples/cpp" -B "${WORK}/find" -G "${GENERATOR}" "-DCMAKE_PREFIX_PATH=${PREFIX}"
  "-DCMAKE_BUILD_TYPE=${CONFIG}" "-DCMAKE_CXX_FLAGS=-Wall -Wextra")
run(${CMAKE_COMMAND} --build "${WORK}/find" --config "${CONFIG}")
foreach(models "${MODEL}" "${MODEL};${FIRST_LOOK}")
  run("${WORK}/find/filter_matches" ${models})
  if(NOT OUTPUT MATCHES "^ok: ")
    message(FATAL_ERROR "filter_matches ${models}: ${OUTPUT}")
  endif()
endforeach()

if(EMBEDDED)
  run("${WORK}/find/filter_matches")
  if(NOT OUTPUT MATCHES "^ok: ")
    message(FATAL_ERROR "filter_matches with the embedded models: ${OUTPUT}")
  endif()
endif()

file(GLOB ODOMETRY "${WORK}/find/odometry*")
if(ODOMETRY)  # OpenCV has the modules for it
  foreach(source orb flow)
    run("${WORK}/find/odometry" "${SOURCE}/examples/images" 800,800,319.5,239.5 ${source} "${MODEL}" "${FIRST_LOOK}")
    if(NOT OUTPUT MATCHES "1 pairs: features and matching [0-9.]+ ms, filter [0-9.]+ ms per frame")
      message(FATAL_ERROR "odometry ${source}: ${OUTPUT}")
    endif()
  endforeach()
endif()

# A version that is not there is refused.
file(WRITE "${WORK}/newer/CMakeLists.txt"
  "cmake_minimum_required(VERSION 3.16)\nproject(newer CXX)\nfind_package(mgca 99.0 REQUIRED)\n")
execute_process(COMMAND ${CMAKE_COMMAND} -S "${WORK}/newer" -B "${WORK}/newer/build" "-DCMAKE_PREFIX_PATH=${PREFIX}"
  RESULT_VARIABLE code OUTPUT_QUIET ERROR_VARIABLE error)
if(code EQUAL 0 OR NOT error MATCHES "99.0")
  message(FATAL_ERROR "find_package(mgca 99.0) should have failed")
endif()

find_program(PKG_CONFIG pkg-config)
find_program(CXX NAMES c++ g++ clang++)
if(PKG_CONFIG AND CXX)
  file(GLOB PC "${PREFIX}/lib*/pkgconfig" "${PREFIX}/lib/*/pkgconfig")
  set(ENV{PKG_CONFIG_PATH} "${PC}")
  execute_process(COMMAND "${PKG_CONFIG}" --cflags --libs mgca OUTPUT_VARIABLE flags RESULT_VARIABLE code
    OUTPUT_STRIP_TRAILING_WHITESPACE)
  if(NOT code EQUAL 0)
    message(FATAL_ERROR "pkg-config does not find mgca in ${PC}")
  endif()
  separate_arguments(flags UNIX_COMMAND "${flags}")
  run("${CXX}" -std=c++17 "${SOURCE}/examples/cpp/filter_matches.cpp" -o "${WORK}/by_pkg_config" ${flags}
    "-Wl,-rpath,${ROOT}/lib" "-Wl,-rpath,${PREFIX}/lib")
  run("${WORK}/by_pkg_config" "${MODEL}")
else()
  message(STATUS "pkg-config or c++ not found: its part is skipped")
endif()

# FetchContent configures cpp as a part of another project: no tests, no tools, warnings are no errors.
file(WRITE "${WORK}/fetch/CMakeLists.txt" "
cmake_minimum_required(VERSION 3.18)
project(fetches CXX)
include(FetchContent)
FetchContent_Declare(mgca SOURCE_DIR \"${SOURCE}\" SOURCE_SUBDIR cpp)
FetchContent_MakeAvailable(mgca)
if(TARGET mgca_match OR TARGET test_golden)
  message(FATAL_ERROR \"tools and tests are not for those who fetch\")
endif()
add_executable(program \"${SOURCE}/examples/cpp/filter_matches.cpp\")
target_link_libraries(program PRIVATE mgca::filter)
")
run(${CMAKE_COMMAND} -S "${WORK}/fetch" -B "${WORK}/fetch/build" -G "${GENERATOR}" "-DONNXRUNTIME_ROOT=${ROOT}")
message(STATUS "installed, found, linked and run")
