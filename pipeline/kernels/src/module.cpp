// The Python module: picks the build for this processor and hands numpy arrays to it.
#include "module_arrays.h"
#include "registration_module.h"

namespace raster {

void* allocate_aligned(size_t bytes) {
    void* memory = nullptr;
    if (posix_memalign(&memory, 64, bytes ? bytes : 1)) throw std::bad_alloc();
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
                kept_ -= capacity;
                free_.erase(free_.begin() + static_cast<std::ptrdiff_t>(i));
                return memory;
            }
        return static_cast<float*>(allocate_aligned(capacity * sizeof(float)));
    }
    void give_back(float* memory, size_t capacity) {
        const std::lock_guard<std::mutex> lock(mutex_);
        free_.push_back({memory, capacity});
        kept_ += capacity;
        while (free_.size() > KEPT || kept_ > KEPT_FLOATS) {
            kept_ -= free_.front().capacity;
            release_aligned(free_.front().memory);
            free_.erase(free_.begin());
        }
    }
    // An array of `count` floats, holding anything.
    static nb::ndarray<nb::numpy, float, nb::ndim<1>> array(size_t count) {
        size_t capacity = 1024;
        while (capacity < count) capacity *= 2;
        if (!SLACK) capacity = count;
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
    static constexpr size_t KEPT = 24, KEPT_FLOATS = size_t{1} << 26;  // 256 MiB
    std::mutex mutex_;
    size_t kept_ = 0;  // floats that nobody uses
    std::vector<Loan> free_;
};

// Peaks of the machine, over `seconds`: GFLOP/s of multiply-adds; GB/s of reading and of copying.
static double fma_rate(const std::string& isa, int threads, double seconds) {
    const Kernels* kernels = kernels_named(isa);
    const nb::gil_scoped_release unlocked;
    return kernels->fma_rate(threads, seconds);
}
static nb::tuple bandwidth(int threads, double seconds) {
    double read = 0.0, copied = 0.0;
    {
        const nb::gil_scoped_release unlocked;
        usable_kernels().front()->bandwidth(threads, seconds, &read, &copied);
    }
    return nb::make_tuple(read, copied);
}

constexpr size_t MEANS = 0, LOG_SCALES = 2;  // among the kinds of parameters

// Shapes are checked by pipeline.kernels.adam, the only caller. The lists have an array for each kind of parameter; rows and
// chosen may be empty; limits: the greatest log-scale, and the largest opacity logit.
static void adam(const std::string& isa, const Array<const int64_t>& rows, const Array<const uint8_t>& chosen,
                 const std::vector<Floats>& values, const std::vector<Inputs>& gradients, const std::vector<Floats>& first,
                 const std::vector<Floats>& second, const Inputs& rates, const Inputs& constants, const Inputs& d_colors,
                 const Inputs& d_logits, const Array<int32_t>& steps, const Inputs& corrections, const Floats& log_scales,
                 const Floats& opacity_logits, const Inputs& least, const Inputs& limits, int threads) {
    AdamStep step;
    step.count = d_logits.shape(0);
    step.rows = rows.size() ? rows.data() : nullptr;
    step.chosen = chosen.size() ? chosen.data() : nullptr;
    for (size_t k = 0; k < std::size(step.arrays); k++)
        step.arrays[k] = {values[k].data(), gradients[k].data(), first[k].data(),
                          second[k].data(), rates.data()[k],     gradients[k].ndim() > 1 ? gradients[k].shape(1) : 1,
                          k == MEANS};
    const float* c = constants.data();
    step.constants = {c[0], c[1], c[2], c[3], c[4]};
    step.log_scales = values[LOG_SCALES].data();
    step.d_colors = d_colors.data(), step.d_opacity_logits = d_logits.data();
    step.steps = steps.data(), step.corrections = corrections.data(), step.longest = static_cast<int32_t>(corrections.size());
    const AdamLimits within = {log_scales.data(),  opacity_logits.data(), least.data(),
                               least.size() > 1, limits.data()[0],     limits.data()[1]};
    const Kernels* kernels = kernels_named(isa);
    const nb::gil_scoped_release unlocked;
    kernels->adam(step, within, threads);
}

// Shapes and ranges are checked by pipeline.kernels.rasterizer, the only caller.
class Raster {
public:
    explicit Raster(const std::string& isa) : kernels_(kernels_named(isa)) {}
    std::string isa() const { return kernels_->name; }
    size_t visible() const { return frame_.visible; }
    size_t intersections() const { return frame_.intersection_count; }
    size_t scratch_bytes() const { return frame_.bytes(); }

    int forward(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                const Inputs& pose, const Inputs& intrinsics, const Inputs& background, const Bytes& mask, bool ray_plane, int width,
                int height, int threads, const Floats& color, const Floats& depth, const Floats& alpha, const Floats& layer, float tolerance) {
        const Use use(busy_);
        look(pose, intrinsics, background, mask, ray_plane, width, height, threads);
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        const Images images = {color.data(), depth.data(), alpha.data(), data_or_null(layer), tolerance};
        return static_cast<int>(kernels_->forward(frame_, gaussians, images));
    }

    // Forward, loss and backward; weights: of the loss, then gain, offset, and the weight of surface. values: as LossValues.
    int fit(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
            const Inputs& pose, const Inputs& intrinsics, const Inputs& background, const Bytes& mask, bool ray_plane, int width,
            int height, int threads, const Inputs& color, const Inputs& depth_m, const Inputs& weights, const Array<double>& values, const Floats& g_means,
            const Floats& g_quats, const Floats& g_log_scales, const Floats& g_colors, const Floats& g_logits,
            const Array<double>& g_pose, const Inputs& certainty, const Bytes& bytes, const Inputs& of_bytes) {
        const Use use(busy_);
        look(pose, intrinsics, background, mask, ray_plane, width, height, threads);
        const float* w = weights.data();
        const Loss loss = {data_or_null(color), depth_m.data(), bytes.is_valid() ? bytes.data() : nullptr,
                           of_bytes.is_valid() ? of_bytes.data() : nullptr, certainty.is_valid() ? data_or_null(certainty) : nullptr, w[0], w[1], w[2], w[3], w[6], w[4], w[5], w[7]};
        const GradientArrays out = {data_or_null(g_means),  data_or_null(g_quats), data_or_null(g_log_scales), data_or_null(g_colors),
                                    data_or_null(g_logits), nullptr,               data_or_null(g_pose)};
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        LossValues found = {};
        const Status status = kernels_->fit(frame_, gaussians, loss, found, out);
        const double all[LOSS_SUMS] = {found.color, found.depth, found.missing_alpha, found.by_log_gain, found.by_offset, found.surface};
        std::copy(all, all + LOSS_SUMS, values.data());
        return static_cast<int>(status);
    }

    int backward(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                 const Inputs& d_color, const Inputs& d_depth, const Inputs& d_alpha, const Floats& g_means, const Floats& g_quats,
                 const Floats& g_log_scales, const Floats& g_colors, const Floats& g_logits, const Floats& fisher,
                 const Array<double>& pose) {
        const Use use(busy_);
        const GradientArrays out = {data_or_null(g_means), data_or_null(g_quats), data_or_null(g_log_scales), data_or_null(g_colors),
                                    data_or_null(g_logits), data_or_null(fisher), data_or_null(pose)};
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(
            kernels_->backward(frame_, gaussians, d_color.data(), data_or_null(d_depth), data_or_null(d_alpha), out));
    }

    int fisher(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
               const Inputs& inv_var_color, const Inputs& inv_var_depth, const Inputs& residual, const Array<double>& geometry,
               const Array<double>& color, const Array<double>& opacity, const Array<double>& weight,
               const Array<double>& residuals, const Array<double>& diagonal, const Array<uint32_t>& observations) {
        const Use use(busy_);
        const FisherArrays out = {geometry.data(),  color.data(),           opacity.data(),     weight.data(),
                                  residuals.data(), data_or_null(diagonal), observations.data()};
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(
            kernels_->fisher(frame_, gaussians, inv_var_color.data(), inv_var_depth.data(), data_or_null(residual), out));
    }

    int opacity_information(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                            const Inputs& inv_var_color, const Inputs& inv_var_depth, const Array<double>& information,
                            const Array<uint32_t>& observations) {
        const Use use(busy_);
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(kernels_->opacity_information(frame_, gaussians, inv_var_color.data(), inv_var_depth.data(),
                                                              information.data(), observations.data()));
    }

    int full_fisher(const Inputs& means, const Inputs& quats, const Inputs& log_scales, const Inputs& colors, const Inputs& logits,
                    const Inputs& inv_var_color, const Inputs& inv_var_depth, const Array<double>& information) {
        const Use use(busy_);
        const GaussianArrays gaussians = arrays_of(means, quats, log_scales, colors, logits);
        const nb::gil_scoped_release unlocked;
        return static_cast<int>(
            kernels_->full_fisher(frame_, gaussians, inv_var_color.data(), inv_var_depth.data(), information.data()));
    }

    void contributions(const Floats& weights, const Array<uint32_t>& pixels) {
        const Use use(busy_);
        const nb::gil_scoped_release unlocked;
        kernels_->contributions(frame_, weights.data(), pixels.data());
    }

    // Pairs of a pixel and a Gaussian in the last view: whose alpha was computed, that were blended.
    std::pair<uint64_t, uint64_t> pairs() const {
        uint64_t evaluated = 0, blended = 0;
        for (int tile = 0; tile < frame_.tiles_x * frame_.tiles_y; tile++) {
            evaluated += frame_.evaluated.data()[tile] * 16;
            uint32_t items = 0;
            for (int b = 0; b < BLOCKS; b++) items += frame_.block_items.data()[static_cast<size_t>(tile) * BLOCKS + b];
            const uint16_t* pixels = frame_.item_pixels.data() + frame_.item_start.data()[tile];
            for (uint32_t i = 0; i < items; i++) blended += static_cast<uint64_t>(__builtin_popcount(pixels[i]));
        }
        return {evaluated, blended};
    }

private:
    void look(const Inputs& pose, const Inputs& intrinsics, const Inputs& background, const Bytes& mask, bool ray_plane, int width,
              int height, int threads) {
        View& view = frame_.view;
        for (int i = 0; i < 3; i++) {
            for (int k = 0; k < 3; k++) view.R[3 * i + k] = pose.data()[4 * i + k];
            view.t[i] = pose.data()[4 * i + 3];
            view.background[i] = background.data()[i];
        }
        view.fx = intrinsics.data()[0], view.fy = intrinsics.data()[1];
        view.cx = intrinsics.data()[2], view.cy = intrinsics.data()[3];
        view.width = width, view.height = height;
        mask_.assign(mask.data(), mask.data() + mask.size());  // the backward passes need it too
        view.mask = mask_.empty() ? nullptr : mask_.data();
        view.depth = ray_plane ? DepthKind::ray_plane : DepthKind::blended;
        frame_.threads = threads;
    }
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
    const Kernels* kernels_;
    Frame frame_;
    std::vector<uint8_t> mask_;
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
        .def_prop_ro("pairs", &Raster::pairs)
        .def_prop_ro("scratch_bytes", &Raster::scratch_bytes)
        .def("forward", &Raster::forward)
        .def("fit", &Raster::fit, "means"_a, "quats"_a, "log_scales"_a, "colors"_a, "logits"_a, "pose"_a, "intrinsics"_a, "background"_a,
             "mask"_a, "ray_plane"_a, "width"_a, "height"_a, "threads"_a, "color"_a, "depth_m"_a, "weights"_a, "values"_a, "g_means"_a,
             "g_quats"_a, "g_log_scales"_a, "g_colors"_a, "g_logits"_a, "g_pose"_a, "certainty"_a.none() = nb::none(),
             "bytes"_a.none() = nb::none(), "of_bytes"_a.none() = nb::none())
        .def("backward", &Raster::backward)
        .def("fisher", &Raster::fisher)
        .def("opacity_information", &Raster::opacity_information)
        .def("full_fisher", &Raster::full_fisher)
        .def("contributions", &Raster::contributions);
    m.def("adam", &raster::adam);
    m.def("empty", &raster::OutputPool::array);
    m.def("fma_rate", &raster::fma_rate);
    m.def("bandwidth", &raster::bandwidth);
    raster::define_registration(m);
    m.def("available_isas", [] {
        std::vector<std::string> names;
        for (const raster::Kernels* kernels : raster::usable_kernels()) names.push_back(kernels->name);
        return names;
    });
}
