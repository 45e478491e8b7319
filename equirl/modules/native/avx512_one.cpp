// The kernels for processors with AVX-512, for one image at a time.
#define EQUIRL_ONE_IMAGE
#include "kernels.hpp"
