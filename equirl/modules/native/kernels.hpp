// Convolutions between fields of a group, at the cost the symmetry leaves.
//
// An equivariant 3 x 3 filter is a combination of six pixel functions: the centre, the
// four edges with the corners, x^2 - y^2, xy, x and y. With the fields split into irreducible parts
// (a Fourier transform of regular fields; those of SO(2) and O(2) are) the contraction falls
// apart into one small matrix product per irreducible representation. A layer is computed tile
// by tile, with everything in cache:
//
//   strip of the input -> irreducible parts -> six functions -> matrix products
//         -> bias, and either inverse transform, 2 x 2 maximum, ReLU or gates, pooling -> output
//
// The gradient of the input is the same computation with other weights; that of the
// weights is a product of the two spectral tiles. Which row of a spectral tile holds what
// is stated in rows.py; spectral.py derives the weights from the dense filters.
//
// Feature maps are stored as [batch / 16][field][row][column][channel of the field][16]:
// sixteen images side by side, so that every operation is one on vectors and no width leaves
// a remainder, and the channels of a field next to one another. A few
// images would leave those lanes empty: compiled with EQUIRL_ONE_IMAGE, the file gives the
// forward pass for maps of one image, whose vectors run over the rows of the products.

#include "outputs.hpp"

extern "C" {
struct Layer {
    int32_t group;       // 0 to 3: C4, D4, SO(2), O(2)
    int32_t hidden;      // whether the input fields are hidden ones (1) or trivial (0)
    int32_t fields_in;
    int32_t fields_out;  // always hidden
    int32_t height;      // of the input
    int32_t width;
    int32_t padding;     // 0 to 2
    int32_t pool;        // Pool; then the convolution's height and width are even
    int32_t activation;  // of C4 and D4, a ReLU; the others always have their gates
    float edge;          // weight of the corners in the functions of even frequency
    float axis;          // weight of the corners in the functions x and y
};
}

namespace {

inline Sizes sizes_of(const Layer& layer) {
    const int shrink = 2 - 2 * layer.padding;
    return {layer.fields_in,      layer.fields_out,    layer.height,  layer.width,
            layer.height - shrink, layer.width - shrink, layer.padding, layer.edge, layer.axis};
}

/// The convolution that takes an output gradient to that of the input.
inline Sizes adjoint(const Sizes& s) {
    return {s.fields_out, s.fields_in, s.height_out, s.width_out, s.height_in,
            s.width_in,   2 - s.padding, s.edge,     s.axis};
}

/// Calls `call` with an object of the group's type.
template <class Call>
void with_space(int group, const Call& call) {
    switch (group) {
        case 0: return call(Regular<false>{});
        case 1: return call(Regular<true>{});
        case 2: return call(Irreducible<false>{});
        default: return call(Irreducible<true>{});
    }
}

/// Lays out a spectral tile of some rows per irrep in memory; returns its size in floats.
template <class Space>
size_t lay_out(float* memory, int pixels, int fields, const int* rows, Spectral* tile) {
    constexpr int kSpare = 16;  // rows are read, or written, in whole groups
    tile->pixels = pixels;
    size_t used = 0;
    for (int r = 0; r < Space::irreps; ++r) {
        tile->part[r] = reinterpret_cast<Vec*>(memory) + used;
        used += size_t(fields * rows[r] + kSpare) * tile->stride(Space::dim[r]);
    }
    return used * kLanes;
}

/// The spectral input and output of a tile in this thread's memory.
template <class Space, class In, class Out>
void lay_out_tiles(int pixels, int fields_in, int fields_out, Spectral* v, Spectral* o) {
    const size_t in_size = lay_out<Space>(nullptr, pixels, fields_in, In::rows, v);
    const size_t out_size = lay_out<Space>(nullptr, pixels, fields_out, Out::copies, o);
    float* memory = scratch<1>(in_size + out_size);
    lay_out<Space>(memory, pixels, fields_in, In::rows, v);
    lay_out<Space>(memory + in_size, pixels, fields_out, Out::copies, o);
}

/// Input fields that are transformed at a time, so that they stay in cache.
template <class Space, class In>
int fields_at_once(int fields, int pixels, size_t bytes) {
    size_t values = 0;
    for (int r = 0; r < Space::irreps; ++r) values += In::rows[r] * Space::dim[r];
    int count = int(bytes / (values * pixels * sizeof(Vec))) & ~3;  // whole groups, for correlate()
    if (count < 4) count = 4;
    return count < fields ? count : fields;
}

/// Number of weights of a pair of fields.
template <class Space, class In, class Out>
constexpr int pair_size() {
    int size = 0;
    for (int r = 0; r < Space::irreps; ++r) size += Out::copies[r] * In::rows[r];
    return size;
}

/// Weights [fields out][fields in][irrep][copy][row] to the order in which multiply() reads them.
template <class Space, class In, class Out>
void pack(const Sizes& s, const float* weights, float* packed, const float** starts) {
    constexpr int size = pair_size<Space, In, Out>();
    const int ci = s.fields_in, co = s.fields_out;
    for (int r = 0, offset = 0; r < Space::irreps; offset += Out::copies[r] * In::rows[r], ++r) {
        // Copy c of output field o is row c * co + o.
        const int rows = In::rows[r], m = Out::copies[r] * co, K = ci * rows;
        for (int i = 0, height; i < m; i += height) {
            height = height_of(m - i);
            for (int h = 0; h < height; ++h) {
                const int o = (i + h) % co, c = (i + h) / co;
                const float* from = weights + size_t(o) * ci * size + offset + c * rows;
                float* to = packed + size_t(i) * K + h;
                for (int f = 0; f < ci; ++f, from += size)
                    for (int k = 0; k < rows; ++k)
                        to[(size_t(f) * rows + k) * height] = i + h < m ? from[k] : 0;
            }
        }
        starts[r] = packed;
        packed += size_t(padded(m)) * K;
    }
}

constexpr size_t kCache = 400 << 10;  // bytes of spectral input at a time: within a 1 MB L2 cache

/// Convolves every block. `source` and `target` give the maps of a block and split.
template <class Space, class In, class Out, class MakeSource, class MakeTarget>
void convolve(const Sizes& s, int blocks, const float* weights, int threads,
              const MakeSource& source_of, const MakeTarget& target_of) {
    constexpr int irreps = Space::irreps;
    size_t count = 0;
    Steps steps[irreps];
    const Tile shape = tile_of(s.height_out, s.width_out);
    const int n = shape.pixels();
    for (int r = 0; r < irreps; ++r) {
        const int m = Out::copies[r] * s.fields_out;
        count += size_t(s.fields_in) * In::rows[r] * padded(m);
        steps[r] = steps_of(m, Spectral{{}, n}.stride(Space::dim[r]));
    }
    float* packed = scratch<0>(count);
    const float* starts[irreps];
    pack<Space, In, Out>(s, weights, packed, starts);

    const int strips = s.height_out / shape.rows, items = blocks * kSplits * strips;
    const int chunk = fields_at_once<Space, In>(s.fields_in, n, kCache);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int item = 0; item < items; ++item) {
        Spectral v, o;
        lay_out_tiles<Space, In, Out>(n, chunk, s.fields_out, &v, &o);
        const int block = item / strips;
        const auto source = source_of(block / kSplits, block % kSplits);
        const Target target = target_of(block / kSplits, block % kSplits);
        Tile tile = shape;
        tile.row = item % strips * shape.rows;
        for (; tile.column < s.width_out; tile.column += shape.columns) {
            for (int f = 0; f < s.fields_in; f += chunk) {
                const int fields = f + chunk < s.fields_in ? chunk : s.fields_in - f;
                spectral_input<Space, In>(source, tile, s.padding, s.edge, s.axis, f, fields, v);
                for (int r = 0; r < irreps; ++r) {
                    const int rows = In::rows[r], dim = Space::dim[r];
                    multiply(Out::copies[r] * s.fields_out, dim * n, fields * rows, f * rows,
                             s.fields_in * rows, starts[r], v.part[r], v.stride(dim), o.part[r],
                             f > 0);
                }
            }
            if constexpr (Space::gated && Out::channels == Space::Output::channels)
                finish_gated<Space::mirror>(target, s, tile, o, steps);
            else
                finish_plain<Space, Out>(target, s, tile, o, steps);
        }
    }
}

#if !defined(EQUIRL_ONE_IMAGE)
inline int groups(int rows) { return (rows + 3) / 4; }

/// Gradients of the weights and the bias. Work is divided into at most eight parts, whatever
/// the number of threads, and summed in order: the result does not depend on that number.
template <class Space, class In, class Out, class MakeSource, class MakeGradient>
void correlate_maps(const Sizes& s, int blocks, float* weights, float* bias, int threads,
                    const MakeSource& source_of, const MakeGradient& gradient_of) {
    constexpr int irreps = Space::irreps;
    const int ci = s.fields_in, co = s.fields_out, biases = Out::copies[0] * co;
    const Tile shape = tile_of(s.height_out, s.width_out);
    const int n = shape.pixels(), strips = s.height_out / shape.rows;
    const int items = blocks * kSplits * strips, parts = items < 8 ? items : 8;
    const int chunk = fields_at_once<Space, In>(ci, n, kCache);

    size_t offset[irreps], size = 0;  // of each irrep's sums, then the bias
    for (int r = 0; r < irreps; ++r) {
        offset[r] = size;
        size += size_t(groups(Out::copies[r] * co)) * groups(ci * In::rows[r]) * 16;
    }
    const size_t shift = size;
    size = (size + biases + 15) & ~size_t(15);
    float* sums = scratch<0>(size * parts);

#pragma omp parallel for schedule(static, 1) num_threads(threads)
    for (int part = 0; part < parts; ++part) {
        Spectral v, o;
        lay_out_tiles<Space, In, Out>(n, chunk, co, &v, &o);
        float* sum = sums + size * part;
        std::memset(sum, 0, size * sizeof(float));
        const int first = int(int64_t(items) * part / parts);
        const int last = int(int64_t(items) * (part + 1) / parts);
        for (int item = first; item < last; ++item) {
            const int block = item / strips;
            const auto source = source_of(block / kSplits, block % kSplits);
            const auto gradient = gradient_of(block / kSplits, block % kSplits);
            Tile tile = shape;
            tile.row = item % strips * shape.rows;
            for (; tile.column < s.width_out; tile.column += shape.columns) {
                spectral_output<Space, Out>(gradient, tile, co, o);
                for (int f = 0; f < biases; ++f) {
                    Vec total = {};
                    for (int p = 0; p < n; ++p) total += o.part[0][f * o.stride(1) + p];
                    for (int l = 0; l < kLanes; ++l) sum[shift + f] += total[l];
                }
                for (int f = 0; f < ci; f += chunk) {
                    const int fields = f + chunk < ci ? chunk : ci - f;
                    spectral_input<Space, In>(source, tile, s.padding, s.edge, s.axis, f, fields, v);
                    for (int r = 0; r < irreps; ++r) {
                        const int rows = In::rows[r], dim = Space::dim[r];
                        correlate(Out::copies[r] * co, fields * rows, dim * n, o.part[r],
                                  o.stride(dim), v.part[r], v.stride(dim),
                                  sum + offset[r] + f * rows / 4 * 16, groups(ci * rows));
                    }
                }
            }
        }
    }

    for (int part = 1; part < parts; ++part)
        for (size_t i = 0; i < size; ++i) sums[i] += sums[size * part + i];
    for (int f = 0; f < biases; ++f) bias[f] = sums[shift + f];
    constexpr int stride = pair_size<Space, In, Out>();
    for (int r = 0, column = 0; r < irreps; ++r) {
        const int rows = In::rows[r];
        for (int c = 0; c < Out::copies[r]; ++c, column += rows)
            for (int o = 0; o < co; ++o) {
                const int i = c * co + o;
                const float* row =
                    sums + offset[r] + (size_t(i / 4) * groups(ci * rows)) * 16 + i % 4 * 4;
                float* to = weights + size_t(o) * ci * stride + column;
                for (int j = 0; j < ci * rows; ++j)
                    to[size_t(j / rows) * stride + j % rows] = row[j / 4 * 16 + j % 4];
            }
    }
}

#endif

/// Where the image lanes of a split start in a map of some fields.
template <int Channels>
size_t offset_of(const Map<Channels>& map, int fields, int block, int split) {
    return block * map.size(fields) + split * kLanes;
}

template <class Space, class In>
void forward(const Layer& layer, int blocks, const float* x, const float* weights,
             const float* bias, float* y, uint8_t* choice, float* raw, int threads) {
    using Out = typename Space::Output;
    const Sizes s = sizes_of(layer);
    const Map<In::channels> in = {s.height_in, s.width_in};
    const int shift = layer.pool ? 1 : 0;
    const Map<Space::Hidden::channels> out = {s.height_out >> shift, s.width_out >> shift};
    const Map<Out::channels> all = {s.height_out, s.width_out};
    large_pages(y, blocks * out.size(s.fields_out) * sizeof(float));
    if (choice) large_pages(choice, blocks * out.size(s.fields_out));
    if (raw) large_pages(raw, blocks * all.size(s.fields_out) * sizeof(float));
    convolve<Space, In, Out>(
        s, blocks, weights, threads,
        [&](int block, int split) {
            return Plain<In::channels>{in, x + offset_of(in, s.fields_in, block, split)};
        },
        [&](int block, int split) {
            const size_t i = offset_of(out, s.fields_out, block, split);
            const size_t j = offset_of(all, s.fields_out, block, split);
            return Target{y + i,      choice ? choice + i : nullptr, raw ? raw + j : nullptr,
                          bias,       layer.pool,                    layer.activation != 0};
        });
}

inline void call_forward(const Layer& layer, int blocks, const float* x, const float* weights,
                         const float* bias, float* y, uint8_t* choice, float* raw, int threads) {
    const auto call = [&](auto space) {
        using Space = decltype(space);
        const auto run = layer.hidden ? forward<Space, typename Space::Hidden>
                                      : forward<Space, typename Space::Trivial>;
        run(layer, blocks, x, weights, bias, y, choice, raw, threads);
    };
    with_space(layer.group, call);
}

#if !defined(EQUIRL_ONE_IMAGE)
/// A function of block and split that gives the gradient before gates and pooling.
template <bool Mirror>
auto ungated(const Layer& layer, const float* raw, const float* gradient) {
    const Sizes s = sizes_of(layer);
    const int shift = layer.pool ? 1 : 0, fields = s.fields_out, pool = layer.pool;
    const Map<Gated<Mirror>::channels> map = {s.height_out >> shift, s.width_out >> shift};
    const Map<Gated<Mirror>::raw> all = {s.height_out, s.width_out};
    return [=](int block, int split) {
        return Ungated<Mirror>{map, all, gradient + offset_of(map, fields, block, split),
                               raw + offset_of(all, fields, block, split), pool};
    };
}

/// Calls `with` with a function of block and split that gives the gradient before pool and
/// activation: from that after them or, with gates, as gate_gradient() has left it.
template <class Space, class With>
void with_gradient(const Layer& layer, const float* gradient, const float* y,
                   const uint8_t* choice, const With& with) {
    constexpr int channels = Space::Output::channels;
    const Sizes s = sizes_of(layer);
    const int shift = layer.pool && !Space::gated ? 1 : 0, fields = s.fields_out;
    const Map<channels> map = {s.height_out >> shift, s.width_out >> shift};
    const auto plain = [=](int block, int split) {
        return Plain<channels>{map, gradient + offset_of(map, fields, block, split)};
    };
    if constexpr (Space::gated) {
        with(plain);
    } else {
        if (layer.pool)
            with([=](int block, int split) {
                const size_t i = offset_of(map, fields, block, split);
                return Unpooled<channels>{map, gradient + i, choice + i};
            });
        else if (layer.activation)
            with([=](int block, int split) {
                const size_t i = offset_of(map, fields, block, split);
                return Masked<channels>{map, gradient + i, y + i};
            });
        else
            with(plain);
    }
}

template <class Space>
void input_gradient(const Layer& layer, int blocks, const float* gradient, const float* y,
                    const uint8_t* choice, const float* weights, float* dx, int threads) {
    using Hidden = typename Space::Hidden;
    const Sizes s = adjoint(sizes_of(layer));
    const Map<Hidden::channels> map = {s.height_out, s.width_out};
    large_pages(dx, blocks * map.size(s.fields_out) * sizeof(float));
    with_gradient<Space>(layer, gradient, y, choice, [&](const auto& source_of) {
        const auto target_of = [&](int block, int split) {
            float* start = dx + offset_of(map, s.fields_out, block, split);
            return Target{start, nullptr, nullptr, nullptr, kNone, false};
        };
        convolve<Space, typename Space::Output, Hidden>(s, blocks, weights, threads, source_of,
                                                        target_of);
    });
}

template <class Space, class In>
void weight_gradient(const Layer& layer, int blocks, const float* x, const float* gradient,
                     const float* y, const uint8_t* choice, const float* raw, float* weights,
                     float* bias, int threads) {
    const Sizes s = sizes_of(layer);
    const Map<In::channels> map = {s.height_in, s.width_in};
    const auto run = [&](const auto& gradient_of) {
        correlate_maps<Space, In, typename Space::Output>(
            s, blocks, weights, bias, threads,
            [&](int block, int split) {
                return Plain<In::channels>{map, x + offset_of(map, s.fields_in, block, split)};
            },
            gradient_of);
    };
    if constexpr (Space::gated)
        if (raw) return run(ungated<Space::mirror>(layer, raw, gradient));
    with_gradient<Space>(layer, gradient, y, choice, run);
}

/// Writes the gradient before gates and pooling, for the input's gradient to read around tiles.
template <bool Mirror>
void gate_gradient(const Layer& layer, int blocks, const float* raw, const float* gradient,
                   float* before, int threads) {
    const Sizes s = sizes_of(layer);
    const int fields = s.fields_out;
    const Map<Gated<Mirror>::raw> all = {s.height_out, s.width_out};
    large_pages(before, blocks * all.size(fields) * sizeof(float));
    const auto source_of = ungated<Mirror>(layer, raw, gradient);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int item = 0; item < blocks * kSplits * fields; ++item) {
        const int field = item % fields, block = item / fields;
        float* to = before + offset_of(all, fields, block / kSplits, block % kSplits);
        const auto source = source_of(block / kSplits, block % kSplits);
        source.each(field, {0, 0, s.height_out, s.width_out}, [&](int pixel, const Vec* values) {
            float* channel = to + all.at(field, 0, pixel);
            for (int c = 0; c < Gated<Mirror>::raw; ++c) store(channel + c * kBlock, values[c]);
        });
    }
}
#endif

}  // namespace

extern "C" {

#if defined(EQUIRL_ONE_IMAGE)

/// equirl_forward() for maps that hold one image each instead of sixteen; nothing is kept.
void equirl_forward_one(const Layer* layer, int32_t images, const float* x, const float* weights,
                        const float* bias, float* y, int32_t threads) {
    call_forward(*layer, images, x, weights, bias, y, nullptr, nullptr, threads);
}

#else

/// Changes with the signatures below and with the order of the rows of rows.py; compared
/// with the number in library.py.
int32_t equirl_interface() { return 5; }

/// y = pool(activation(conv(x) + bias)). What the gradients need is written unless it is null:
/// with C4 and D4 and `pool` to `choice`, with SO(2) and O(2) to `raw`, before the pooling.
void equirl_forward(const Layer* layer, int32_t blocks, const float* x, const float* weights,
                    const float* bias, float* y, uint8_t* choice, float* raw, int32_t threads) {
    call_forward(*layer, blocks, x, weights, bias, y, choice, raw, threads);
}

/// With SO(2) and O(2), the gradient `before` gates and pooling: the `gradient` of the next two.
/// Where that of the input is not wanted, the last takes the gradient after them and `raw`.
void equirl_gate_gradient(const Layer* layer, int32_t blocks, const float* raw,
                          const float* gradient, float* before, int32_t threads) {
    const auto call = layer->group == 3 ? gate_gradient<true> : gate_gradient<false>;
    call(*layer, blocks, raw, gradient, before, threads);
}

/// The gradient of x, for hidden input; `weights` are those of the adjoint convolution.
void equirl_input_gradient(const Layer* layer, int32_t blocks, const float* gradient,
                           const float* y, const uint8_t* choice, const float* weights, float* dx,
                           int32_t threads) {
    with_space(layer->group, [&](auto space) {
        input_gradient<decltype(space)>(*layer, blocks, gradient, y, choice, weights, dx, threads);
    });
}

/// The gradients of the weights and of the bias.
void equirl_weight_gradient(const Layer* layer, int32_t blocks, const float* x,
                            const float* gradient, const float* y, const uint8_t* choice,
                            const float* raw, float* weights, float* bias, int32_t threads) {
    with_space(layer->group, [&](auto space) {
        using Space = decltype(space);
        const auto run = layer->hidden ? weight_gradient<Space, typename Space::Hidden>
                                       : weight_gradient<Space, typename Space::Trivial>;
        run(*layer, blocks, x, gradient, y, choice, raw, weights, bias, threads);
    });
}

#endif

}  // extern "C"
