# Headers, library, CMake package (find_package(mgca)) and pkg-config file.

include(CMakePackageConfigHelpers)

set(MGCA_CMAKE_DIR "${CMAKE_INSTALL_LIBDIR}/cmake/mgca")
install(TARGETS mgca_filter EXPORT mgcaTargets
  ARCHIVE DESTINATION "${CMAKE_INSTALL_LIBDIR}"
  LIBRARY DESTINATION "${CMAKE_INSTALL_LIBDIR}"
  RUNTIME DESTINATION "${CMAKE_INSTALL_BINDIR}")
install(DIRECTORY include/mgca DESTINATION "${CMAKE_INSTALL_INCLUDEDIR}")
install(EXPORT mgcaTargets NAMESPACE mgca:: DESTINATION "${MGCA_CMAKE_DIR}")
install(FILES package.xml DESTINATION "${CMAKE_INSTALL_DATADIR}/mgca")  # for ROS
if(TARGET mgca_match)
  install(TARGETS mgca_match RUNTIME DESTINATION "${CMAKE_INSTALL_BINDIR}")
endif()

configure_package_config_file(cmake/mgcaConfig.cmake.in "${CMAKE_CURRENT_BINARY_DIR}/mgcaConfig.cmake"
  INSTALL_DESTINATION "${MGCA_CMAKE_DIR}")
# Before 1.0 a minor version may change the interface.
write_basic_package_version_file("${CMAKE_CURRENT_BINARY_DIR}/mgcaConfigVersion.cmake" COMPATIBILITY SameMinorVersion)
install(FILES
  "${CMAKE_CURRENT_BINARY_DIR}/mgcaConfig.cmake"
  "${CMAKE_CURRENT_BINARY_DIR}/mgcaConfigVersion.cmake"
  cmake/FindMgcaOnnxRuntime.cmake
  DESTINATION "${MGCA_CMAKE_DIR}")

# A static library leaves its dependencies to the program: then they are named in Libs, else in Libs.private.
set(MGCA_PC_OPENCV "")
foreach(component IN LISTS MGCA_OPENCV_COMPONENTS)
  string(APPEND MGCA_PC_OPENCV " -lopencv_${component}")
endforeach()
set(MGCA_PC_RUNTIME "")
if(MGCA_CHOSEN_RUNTIME STREQUAL "onnxruntime")
  set(MGCA_PC_RUNTIME " ${ONNXRUNTIME_LIBRARY}")
endif()
if(BUILD_SHARED_LIBS)
  set(MGCA_PC_LIBS " -lopencv_core")
  set(MGCA_PC_PRIVATE "${MGCA_PC_OPENCV}${MGCA_PC_RUNTIME}")
else()
  set(MGCA_PC_LIBS "${MGCA_PC_OPENCV}${MGCA_PC_RUNTIME}")
  set(MGCA_PC_PRIVATE "")
endif()
list(GET OpenCV_INCLUDE_DIRS 0 MGCA_PC_OPENCV_INCLUDE)
# Relative to the file itself, so that an installed tree may be moved.
file(RELATIVE_PATH MGCA_PC_PREFIX "/${CMAKE_INSTALL_LIBDIR}/pkgconfig" "/")
if(IS_ABSOLUTE "${CMAKE_INSTALL_LIBDIR}")
  set(MGCA_PC_PREFIX "${CMAKE_INSTALL_PREFIX}")
else()
  set(MGCA_PC_PREFIX "\${pcfiledir}/${MGCA_PC_PREFIX}")
endif()
configure_file(cmake/mgca.pc.in "${CMAKE_CURRENT_BINARY_DIR}/mgca.pc" @ONLY)
install(FILES "${CMAKE_CURRENT_BINARY_DIR}/mgca.pc" DESTINATION "${CMAKE_INSTALL_LIBDIR}/pkgconfig")
