// The kernels for any processor, for one image at a time.
#define EQUIRL_ONE_IMAGE
#include "kernels.hpp"
