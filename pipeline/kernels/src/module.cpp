// The Python module: picks the build for this processor and hands numpy arrays to it.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <atomic>
#include <cstdlib>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "frame.h"

namespace nb = nanobind;

namespace raster {

#if defined(HAVE_AVX512)
extern const Kernels kernels_avx512;
#endif
#if defined(HAVE_AVX2)
extern const Kernels kernels_avx2;
#endif
extern const Kernels kernels_portable;

void* allocate_aligned(size_t bytes) {
    void* memory = std::aligned_alloc(64, (bytes + 63) / 64 * 64);
    if (!memory) throw std::bad_alloc();
    return memory;
}
void release_aligned(void* memory) { std::free(memory); }

// Memory of output arrays, handed out again when numpy lets go of it: fresh memory costs a page fault per 4 KiB,
// which at small images is a tenth of a pass.
class OutputPool {
public:
    static OutputPool& instance() {
        static OutputPool* pool = new OutputPool;  // never destroyed: arrays may outlive the module
        return *pool;
    }
    float* take(size_t capacity) {
        const std::lock_guard<std::mutex> lock(mutex_);
        for (size_t i = 0; i < free_.size(); i++)
            if (free_[i].capacity == capacity) {
                float* memory = free_[i].memory;
                free_.erase(free_.begin() + static_cast<std::ptrdiff_t>(i));
                return memory;
            }
        return static_cast<float*>(allocate_aligned(capacity * sizeof(float)));
    }
    void give_back(float* memory, size_t capacity) {
        const std::lock_guard<std::mutex> lock(mutex_);
        free_.push_back({memory, capacity});
        if (free_.size() > KEPT) {
            release_aligned(free_.front().memory);
            free_.erase(free_.begin());
        }
    }
    // An array of `count` floats, holding anything.
    static nb::ndarray<nb::numpy, float, nb::ndim<1>> array(size_t count) {
        size_t capacity = 1024;
        while (capacity < count) capacity *= 2;
        auto* loan = new Loan{instance().take(capacity), capacity};
        const nb::capsule owner(loan, [](void* p) noexcept {
            auto* loan = static_cast<Loan*>(p);
            instance().give_back(loan->memory, loan->capacity);
            delete loan;
        });
        return nb::ndarray<nb::numpy, float, nb::ndim<1>>(loan->memory, {count}, owner);
    }

private:
    struct Loan {
        float* memory;
        size_t capacity;
    };
    static constexpr size_t KEPT = 24;
    std::mutex mutex_;
    std::vector<Loan> free_;
};

// The builds that this processor can run, fastest first.
static std::vector<const Kernels*> usable_kernels() {
    std::vector<const Kernels*> usable;
#if defined(HAVE_AVX512)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        usable.push_back(&kernels_avx512);
#endif
#if defined(HAVE_AVX2)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
        usable.push_back(&kernels_avx2);
#endif
    usable.push_back(&kernels_portable);
    return usable;
}

template <class T>
using Array = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu>;
using Floats = Array<float>;
using Inputs = Array<const float>;

static GaussianArrays arrays_of(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors,
                                const Inputs& logits) {
    return {means.shape(0), means.data(), quats.data(), log_scales.data(), colors.data(), logits.data()};
}

// Shapes and ranges are checked by pipeline.kernels.rasterizer, the only caller.
class Raster {
public:
    explicit Raster(const std::string& isa) {
        for (const Kernels* kernels : usable_kernels())
            if (isa == "auto" || isa == kernels->name) {
                kernels_ = kernels;
                return;
            }
        throw std::invalid_argument("isa: " + isa + " is not available on this processor");
    }
    std::string isa() const { return kernels_->name; }
    size_t visible() const { return frame_.visible; }
    size_t intersections() const { return frame_.intersection_count; }

    int forward(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                const Inputs& pose, const Inputs& intrinsics, const Inputs& background, int width, int height, int threads,
                const Floats& color, const Floats& depth, const Floats& alpha) {
        const Use use(busy_);
        View& view = frame_.view;
        for (int i = 0; i < 3; i++) {
            for (int k = 0; k < 3; k++) view.R[3 * i + k] = pose.data()[4 * i + k];
            view.t[i] = pose.data()[4 * i + 3];
            view.background[i] = background.data()[i];
        }
        view.fx = intrinsics.data()[0], view.fy = intrinsics.data()[1];
        view.cx = intrinsics.data()[2], view.cy = intrinsics.data()[3];
        view.width = width, view.height = height;
        frame_.threads = threads;
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(kernels_->forward(frame_, gaussians, color.data(), depth.data(), alpha.data()));
    }

    int backward(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                 const Inputs& d_color, const Inputs& d_depth, const Inputs& d_alpha, const Floats& g_means, const Floats& g_quats,
                 const Floats& g_log_scales, const Floats& g_colors, const Floats& g_logits, const Floats& fisher,
                 const Array<double>& pose) {
        const Use use(busy_);
        const GradientArrays out = {g_means.data(), g_quats.data(), g_log_scales.data(), g_colors.data(), g_logits.data(),
                                    fisher.size() ? fisher.data() : nullptr, pose.size() ? pose.data() : nullptr};
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        const float *depth = d_depth.size() ? d_depth.data() : nullptr, *alpha = d_alpha.size() ? d_alpha.data() : nullptr;
        return static_cast<int>(kernels_->backward(frame_, gaussians, d_color.data(), depth, alpha, out));
    }

    int fisher(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
               const Inputs& inv_var_color, const Inputs& inv_var_depth, const Array<double>& geometry,
               const Array<double>& color, const Array<double>& opacity, const Array<uint32_t>& observations) {
        const Use use(busy_);
        const FisherArrays out = {geometry.data(), color.data(), opacity.data(), observations.data()};
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(kernels_->fisher(frame_, gaussians, inv_var_color.data(), inv_var_depth.data(), out));
    }

    void contributions(const Floats& weights, const Array<uint32_t>& pixels) {
        const Use use(busy_);
        const nb::gil_scoped_release unlocked;
        kernels_->contributions(frame_, weights.data(), pixels.data());
    }

private:
    // A call while another runs would write into its scratch memory.
    class Use {
    public:
        explicit Use(std::atomic_flag& busy) : busy_(busy) {
            if (busy_.test_and_set()) throw std::runtime_error("one Rasterizer was called from two threads at once");
        }
        ~Use() { busy_.clear(); }

    private:
        std::atomic_flag& busy_;
    };
    const Kernels* kernels_ = nullptr;
    Frame frame_;
    std::atomic_flag busy_ = ATOMIC_FLAG_INIT;
};

}  // namespace raster

NB_MODULE(_raster, m) {
    using raster::Raster;
    nb::class_<Raster>(m, "Raster")
        .def(nb::init<std::string>())
        .def_prop_ro("isa", &Raster::isa)
        .def_prop_ro("visible", &Raster::visible)
        .def_prop_ro("intersections", &Raster::intersections)
        .def("forward", &Raster::forward)
        .def("backward", &Raster::backward)
        .def("fisher", &Raster::fisher)
        .def("contributions", &Raster::contributions);
    m.def("empty", &raster::OutputPool::array);
    m.def("available_isas", [] {
        std::vector<std::string> names;
        for (const raster::Kernels* kernels : raster::usable_kernels()) names.push_back(kernels->name);
        return names;
    });
}
