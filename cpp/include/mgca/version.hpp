// Version of the library, read by CMake as well; that of the Python package.

#pragma once

#define MGCA_VERSION_MAJOR 0
#define MGCA_VERSION_MINOR 1
#define MGCA_VERSION_PATCH 0
#define MGCA_VERSION "0.1.0"
