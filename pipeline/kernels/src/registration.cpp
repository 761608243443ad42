// The kernels of the registration for one instruction set. Compiled once per set, as kernels.cpp.
#include "drawn_depth.h"
#include "free_space.h"
#include "image_pyramid.h"
#include "moved_depth.h"
#include "registration_search.h"
#include "squared_error.h"
#include "window_terms.h"

namespace raster {
extern const RegistrationKernels REGISTRATION_TABLE;
const RegistrationKernels REGISTRATION_TABLE = {KERNEL_ISA::align_at,      KERNEL_ISA::align,        KERNEL_ISA::gray_of_color,
                                                KERNEL_ISA::gray_of_color, KERNEL_ISA::invert_depth, KERNEL_ISA::halve,
                                                KERNEL_ISA::surface_normals, KERNEL_ISA::move_depth,   KERNEL_ISA::draw_triangles,
                                                KERNEL_ISA::register_depth, KERNEL_ISA::displace_depth,
                                                KERNEL_ISA::free_space,   KERNEL_ISA::window_means, KERNEL_ISA::window_terms,
                                                KERNEL_ISA::squared_error};
}  // namespace raster
