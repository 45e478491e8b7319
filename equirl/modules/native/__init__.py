"""C++ kernels for CPUs, compiled at installation, and the layers that run on them."""
