// The kernels for processors with AVX2 and FMA, for one image at a time.
#define EQUIRL_ONE_IMAGE
#include "kernels.hpp"
