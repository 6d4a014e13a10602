# An overlay port of the repository that it lies in: vcpkg install mgca --overlay-ports=cpp/vcpkg

get_filename_component(SOURCE_PATH "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)

vcpkg_check_features(OUT_FEATURE_OPTIONS FEATURE_OPTIONS
  FEATURES
    embedded-model MGCA_EMBED_MODEL
    tools MGCA_BUILD_TOOLS)
vcpkg_cmake_configure(SOURCE_PATH "${SOURCE_PATH}/cpp"
  OPTIONS
    -DMGCA_RUNTIME=onnxruntime
    -DMGCA_BUILD_TESTS=OFF
    -DMGCA_WARNINGS_AS_ERRORS=OFF
    ${FEATURE_OPTIONS})
vcpkg_cmake_install()
vcpkg_cmake_config_fixup(PACKAGE_NAME mgca CONFIG_PATH lib/cmake/mgca)
vcpkg_fixup_pkgconfig()
if("tools" IN_LIST FEATURES)
  vcpkg_copy_tools(TOOL_NAMES mgca_match AUTO_CLEAN)
endif()
file(REMOVE_RECURSE "${CURRENT_PACKAGES_DIR}/debug/include" "${CURRENT_PACKAGES_DIR}/debug/share")
vcpkg_install_copyright(FILE_LIST "${SOURCE_PATH}/LICENSE")
