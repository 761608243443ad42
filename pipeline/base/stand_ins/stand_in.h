// A function of a library that is not installed.
#pragma once

#include <cstdio>
#include <cstdlib>

#define STAND_IN(function, library, package)                                                              \
    extern "C" [[noreturn]] void function() {                                                             \
        std::fputs("open3d: calls " #function " of " library ", which is not installed; on Debian: "      \
                   "apt-get install " package "\n", stderr);                                              \
        std::abort();                                                                                     \
    }
