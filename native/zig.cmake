# Toolchain of the wheels: zig (a distribution on PyPI) compiles on any machine for the processor and the oldest glibc that
# ZIG_TARGET names, such as aarch64-linux-gnu.2.17. The C++ library is linked statically and hidden: its `operator new`
# must not be replaced by that of another library in the process. `-s` because a strip program is bound to a processor.
set(CMAKE_SYSTEM_NAME Linux)
string(REGEX MATCH "^[^-]+" CMAKE_SYSTEM_PROCESSOR "$ENV{ZIG_TARGET}")
set(CMAKE_CXX_COMPILER python-zig c++ -target $ENV{ZIG_TARGET})
set(CMAKE_MODULE_LINKER_FLAGS_INIT "-s -Wl,--version-script=${CMAKE_CURRENT_LIST_DIR}/exports.map")
set(CMAKE_STRIP "")
