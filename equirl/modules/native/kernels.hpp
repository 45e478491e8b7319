// Convolutions between fields of D4 or C4, at the cost the symmetry leaves.
//
// An equivariant 3 x 3 filter is a combination of six pixel functions: the centre, the
// four edges with the corners, x^2 - y^2, xy, x and y. With a Fourier transform over each
// field the contraction falls apart into one small matrix product per irreducible
// representation. A layer is computed tile by tile, with everything in cache:
//
//   strip of the input -> Fourier transform -> six functions -> matrix products
//         -> inverse transform, bias, 2 x 2 maximum, ReLU -> output
//
// The gradient of the input is the same computation with other weights; that of the
// weights is a product of the two spectral tiles. Which row of a spectral tile holds what
// is stated in spectral.py, which derives the weights from the dense filters.
//
// Feature maps are stored as [batch / 16][field][row][column][channel of the field][16]:
// sixteen images side by side, so that every operation is one on vectors and no width leaves
// a remainder, and the channels that a Fourier transform needs next to one another. A few
// images would leave those lanes empty: compiled with EQUIRL_ONE_IMAGE, the file gives the
// forward pass for maps of one image, whose vectors run over the rows of the products.

#include "products.hpp"

extern "C" {
struct Layer {
    int32_t order;       // of the group: 8 (D4) or 4 (C4)
    int32_t regular;     // whether the input fields are regular (1) or trivial (0)
    int32_t fields_in;
    int32_t fields_out;  // always regular
    int32_t height;      // of the input
    int32_t width;
    int32_t padding;     // 0 to 2
    int32_t pool;        // 2 x 2 maximum; the convolution's height and width are even
    int32_t relu;
    float edge;          // weight of the corners in the function of edges and corners
    float axis;          // weight of the corners in the functions x and y
};
}

namespace {

/// Sizes of one convolution.
struct Sizes {
    int fields_in, fields_out;
    int height_in, width_in, height_out, width_out, padding;
    float edge, axis;
};

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

/// Lays out a spectral tile of `rows` rows per irrep in memory; returns its size in floats.
inline size_t lay_out(float* memory, int pixels, int singles, const int* single, int vector,
                      Spectral* tile) {
    constexpr int kSpare = 16;  // rows are read, or written, in whole groups
    tile->pixels = pixels;
    size_t used = 0;
    for (int s = 0; s < singles; ++s) {
        tile->single[s] = reinterpret_cast<Vec*>(memory) + used;
        used += size_t(single[s] + kSpare) * tile->stride();
    }
    tile->vector = reinterpret_cast<Vec*>(memory) + used;
    used += size_t(vector + kSpare) * tile->stride2();
    return used * kLanes;
}

template <bool Mirror, bool Regular>
size_t lay_out_input(float* memory, int pixels, int fields, Spectral* tile) {
    using R = Rows<Mirror, Regular>;
    int single[4];
    for (int s = 0; s < 4; ++s) single[s] = fields * R::single[s];
    return lay_out(memory, pixels, Group<Mirror>::singles, single, fields * R::vector, tile);
}

template <bool Mirror>
size_t lay_out_output(float* memory, int pixels, int fields, Spectral* tile) {
    const int single[4] = {fields, fields, fields, fields};
    using G = Group<Mirror>;
    return lay_out(memory, pixels, G::singles, single, G::copies * fields, tile);
}

/// The spectral input and output of a tile in this thread's memory.
template <bool Mirror, bool Regular>
void lay_out_tiles(int pixels, int fields_in, int fields_out, Spectral* v, Spectral* o) {
    const size_t in_size = lay_out_input<Mirror, Regular>(nullptr, pixels, fields_in, v);
    const size_t out_size = lay_out_output<Mirror>(nullptr, pixels, fields_out, o);
    float* memory = scratch<1>(in_size + out_size);
    lay_out_input<Mirror, Regular>(memory, pixels, fields_in, v);
    lay_out_output<Mirror>(memory + in_size, pixels, fields_out, o);
}

/// Input fields that are transformed at a time, so that they stay in cache.
template <bool Mirror, bool Regular>
int fields_at_once(int fields, int pixels, size_t bytes) {
    const size_t one = size_t(Regular ? 6 * Group<Mirror>::order : 6) * pixels * sizeof(Vec);
    int count = int(bytes / one) & ~3;  // whole groups of rows, for correlate()
    if (count < 4) count = 4;
    return count < fields ? count : fields;
}

/// Weights [fields out][fields in][...] to the order in which multiply() reads them.
template <bool Mirror, bool Regular>
void pack(const Sizes& s, const float* weights, float* packed, const float** single,
          const float** vector) {
    using R = Rows<Mirror, Regular>;
    using G = Group<Mirror>;
    int size = G::copies * R::vector;
    for (int c = 0; c < G::singles; ++c) size += R::single[c];
    const int ci = s.fields_in, co = s.fields_out;
    // Rows of one irrep: copy c of output field o is row c * co + o.
    const auto irrep = [&](int offset, int rows, int copies) {
        const int m = copies * co, K = ci * rows;
        for (int i = 0, height; i < m; i += height) {
            height = height_of(m - i);
            for (int h = 0; h < height; ++h) {
                const int o = (i + h) % co, c = (i + h) / co;
                const float* from = weights + size_t(o) * ci * size + offset + c * rows;
                float* to = packed + size_t(i) * K + h;
                for (int f = 0; f < ci; ++f, from += size)
                    for (int r = 0; r < rows; ++r)
                        to[(size_t(f) * rows + r) * height] = i + h < m ? from[r] : 0;
            }
        }
        const float* start = packed;
        packed += size_t(padded(m)) * K;
        return start;
    };
    int offset = 0;
    for (int c = 0; c < G::singles; offset += R::single[c], ++c)
        single[c] = irrep(offset, R::single[c], 1);
    *vector = irrep(offset, R::vector, G::copies);
}

/// What becomes of the result of a convolution.
struct Target {
    float* map;
    uint8_t* choice;    // of the maximum, 0 to 3, or 4 where the ReLU blocked; may be null
    const float* bias;  // one per field, or null
    bool pool, relu;
};

/// Inverse transform, bias, maximum and ReLU of a tile.
template <bool Mirror>
void finish(const Target& target, const Sizes& s, const Tile& tile, const Spectral& o) {
    using G = Group<Mirror>;
    const Steps single = steps_of(s.fields_out, o.stride());
    const Steps vector = steps_of(G::copies * s.fields_out, o.stride2());
    const int shift = target.pool ? 1 : 0;
    const Map<G::order> map = {s.height_out >> shift, s.width_out >> shift};
    const auto field_at = [&](int f, int pixel, Vec* values) {
        Vec parts[G::order];
        for (int c = 0; c < G::singles; ++c)
            parts[c] = o.single[c][f * single.row + pixel * single.pixel];
        if (target.bias) parts[0] += target.bias[f];
        for (int c = 0; c < G::copies; ++c) {
            const Vec* row = o.vector + (c * s.fields_out + f) * vector.row + pixel * vector.pixel;
            parts[G::singles + 2 * c] = row[0];
            parts[G::singles + 2 * c + 1] = row[o.pixels * vector.pixel];
        }
        inverse<Mirror>(parts, values);
    };
    for (int f = 0; f < s.fields_out; ++f)
        for (int i = 0; i < tile.rows >> shift; ++i)
            for (int j = 0; j < tile.columns >> shift; ++j) {
                const size_t k = map.at(f, (tile.row >> shift) + i, (tile.column >> shift) + j);
                if (!target.pool) {
                    Vec values[G::order];
                    field_at(f, i * tile.columns + j, values);
                    for (int c = 0; c < G::order; ++c) {
                        const Vec v = target.relu ? keep(~mask(values[c] < 0), values[c]) : values[c];
                        store(target.map + k + c * kBlock, v);
                    }
                    continue;
                }
                Vec values[4][G::order];
                for (int q = 0; q < 4; ++q)
                    field_at(f, (2 * i + q / 2) * tile.columns + 2 * j + q % 2, values[q]);
                for (int c = 0; c < G::order; ++c) {
                    Vec best = values[0][c];
                    Mask choice = {};
                    for (int q = 1; q < 4; ++q) {
                        const Vec v = values[q][c];
                        const Mask better = mask((v > best) | (v != v));  // not a number wins
                        best = better ? v : best;
                        choice = better ? choice - choice + q : choice;
                    }
                    if (target.relu) {
                        const Mask dead = mask(best <= 0);
                        best = keep(~dead, best);
                        choice = dead ? choice - choice + 4 : choice;
                    }
                    store(target.map + k + c * kBlock, best);
                    if (target.choice) store_bytes(target.choice + k + c * kBlock, choice);
                }
            }
}

constexpr size_t kCache = 400 << 10;  // bytes of spectral input at a time: within a 1 MB L2 cache

/// Convolves every block. `source` and `target` give the maps of a block and split.
template <bool Mirror, bool Regular, class MakeSource, class MakeTarget>
void convolve(const Sizes& s, int blocks, const float* weights, int threads,
              const MakeSource& source_of, const MakeTarget& target_of) {
    using G = Group<Mirror>;
    using R = Rows<Mirror, Regular>;
    const size_t count = size_t(s.fields_in) * padded(s.fields_out) * 6 * G::order;
    float* packed = scratch<0>(count);
    const float *single[4], *vector;
    pack<Mirror, Regular>(s, weights, packed, single, &vector);

    const Tile shape = tile_of(s.height_out, s.width_out);
    const int n = shape.pixels();
    const int strips = s.height_out / shape.rows, items = blocks * kSplits * strips;
    const int chunk = fields_at_once<Mirror, Regular>(s.fields_in, n, kCache);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int item = 0; item < items; ++item) {
        Spectral v, o;
        lay_out_tiles<Mirror, Regular>(n, chunk, s.fields_out, &v, &o);
        const int block = item / strips;
        const auto source = source_of(block / kSplits, block % kSplits);
        const Target target = target_of(block / kSplits, block % kSplits);
        Tile tile = shape;
        tile.row = item % strips * shape.rows;
        for (; tile.column < s.width_out; tile.column += shape.columns) {
            for (int f = 0; f < s.fields_in; f += chunk) {
                const int fields = f + chunk < s.fields_in ? chunk : s.fields_in - f;
                spectral_input<Mirror, Regular>(source, tile, s.padding, s.edge, s.axis, f,
                                                fields, v);
                for (int c = 0; c < G::singles; ++c)
                    multiply(s.fields_out, n, fields * R::single[c], f * R::single[c],
                             s.fields_in * R::single[c], single[c], v.single[c], v.stride(),
                             o.single[c], f > 0);
                multiply(G::copies * s.fields_out, 2 * n, fields * R::vector, f * R::vector,
                         s.fields_in * R::vector, vector, v.vector, v.stride2(), o.vector,
                         f > 0);
            }
            finish<Mirror>(target, s, tile, o);
        }
    }
}

#if !defined(EQUIRL_ONE_IMAGE)
inline int groups(int rows) { return (rows + 3) / 4; }

/// Gradients of the weights and the bias. Work is divided into at most eight parts, whatever
/// the number of threads, and summed in order: the result does not depend on that number.
template <bool Mirror, bool Regular, class MakeSource, class MakeGradient>
void correlate_maps(const Sizes& s, int blocks, float* weights, float* bias, int threads,
                    const MakeSource& source_of, const MakeGradient& gradient_of) {
    using G = Group<Mirror>;
    using R = Rows<Mirror, Regular>;
    const int ci = s.fields_in, co = s.fields_out;
    const Tile shape = tile_of(s.height_out, s.width_out);
    const int n = shape.pixels(), strips = s.height_out / shape.rows;
    const int items = blocks * kSplits * strips, parts = items < 8 ? items : 8;
    const int chunk = fields_at_once<Mirror, Regular>(ci, n, kCache);

    size_t offset[5], size = 0;  // of each irrep's sums, then the bias
    for (int c = 0; c < G::singles; ++c) {
        offset[c] = size;
        size += size_t(groups(co)) * groups(ci * R::single[c]) * 16;
    }
    offset[4] = size;
    size += size_t(groups(G::copies * co)) * groups(ci * R::vector) * 16;
    const size_t shift = size;
    size = (size + co + 15) & ~size_t(15);
    float* sums = scratch<0>(size * parts);

#pragma omp parallel for schedule(static, 1) num_threads(threads)
    for (int part = 0; part < parts; ++part) {
        Spectral v, o;
        lay_out_tiles<Mirror, Regular>(n, chunk, co, &v, &o);
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
                spectral_output<Mirror>(gradient, tile, co, o);
                for (int f = 0; f < co; ++f) {
                    Vec total = {};
                    for (int p = 0; p < n; ++p) total += o.single[0][f * o.stride() + p];
                    for (int l = 0; l < kLanes; ++l) sum[shift + f] += total[l];
                }
                for (int f = 0; f < ci; f += chunk) {
                    const int fields = f + chunk < ci ? chunk : ci - f;
                    spectral_input<Mirror, Regular>(source, tile, s.padding, s.edge, s.axis, f,
                                                    fields, v);
                    for (int c = 0; c < G::singles; ++c)
                        correlate(co, fields * R::single[c], n, o.single[c], o.stride(),
                                  v.single[c], v.stride(),
                                  sum + offset[c] + f * R::single[c] / 4 * 16,
                                  groups(ci * R::single[c]));
                    correlate(G::copies * co, fields * R::vector, 2 * n, o.vector, o.stride2(),
                              v.vector, v.stride2(), sum + offset[4] + f * R::vector / 4 * 16,
                              groups(ci * R::vector));
                }
            }
        }
    }

    for (int part = 1; part < parts; ++part)
        for (size_t i = 0; i < size; ++i) sums[i] += sums[size * part + i];
    for (int f = 0; f < co; ++f) bias[f] = sums[shift + f];
    const auto irrep = [&](size_t from, int rows, int copy, float* to, int stride) {
        for (int o = 0; o < co; ++o) {
            const int i = copy * co + o;
            const float* row = sums + from + (size_t(i / 4) * groups(ci * rows)) * 16 + i % 4 * 4;
            for (int f = 0; f < ci; ++f)
                for (int r = 0; r < rows; ++r) {
                    const int j = f * rows + r;
                    to[(size_t(o) * ci + f) * stride + r] = row[j / 4 * 16 + j % 4];
                }
        }
    };
    int stride = G::copies * R::vector, column = 0;
    for (int c = 0; c < G::singles; ++c) stride += R::single[c];
    for (int c = 0; c < G::singles; column += R::single[c], ++c)
        irrep(offset[c], R::single[c], 0, weights + column, stride);
    for (int c = 0; c < G::copies; ++c)
        irrep(offset[4], R::vector, c, weights + column + c * R::vector, stride);
}

#endif

/// Where the image lanes of a split start in a map of some fields.
template <int Channels>
size_t offset_of(const Map<Channels>& map, int fields, int block, int split) {
    return block * map.size(fields) + split * kLanes;
}

template <bool Mirror, bool Regular>
void forward(const Layer& layer, int blocks, const float* x, const float* weights,
             const float* bias, float* y, uint8_t* choice, int threads) {
    constexpr int order = Group<Mirror>::order;
    const Sizes s = sizes_of(layer);
    const Map<Regular ? order : 1> in = {s.height_in, s.width_in};
    const int shift = layer.pool ? 1 : 0;
    const Map<order> out = {s.height_out >> shift, s.width_out >> shift};
    large_pages(y, blocks * out.size(s.fields_out) * sizeof(float));
    if (choice) large_pages(choice, blocks * out.size(s.fields_out));
    convolve<Mirror, Regular>(
        s, blocks, weights, threads,
        [&](int block, int split) {
            return Plain<Regular ? order : 1>{in, x + offset_of(in, s.fields_in, block, split)};
        },
        [&](int block, int split) {
            const size_t i = offset_of(out, s.fields_out, block, split);
            uint8_t* chosen = choice ? choice + i : nullptr;
            return Target{y + i, chosen, bias, layer.pool != 0, layer.relu != 0};
        });
}

inline void call_forward(const Layer& layer, int blocks, const float* x, const float* weights,
                         const float* bias, float* y, uint8_t* choice, int threads) {
    const auto d4 = layer.regular ? forward<true, true> : forward<true, false>;
    const auto c4 = layer.regular ? forward<false, true> : forward<false, false>;
    (layer.order == 8 ? d4 : c4)(layer, blocks, x, weights, bias, y, choice, threads);
}

#if !defined(EQUIRL_ONE_IMAGE)
/// Calls `with` with a function of block and split that gives the gradient before pool and ReLU.
template <bool Mirror, class With>
void with_gradient(const Layer& layer, const float* gradient, const float* y,
                   const uint8_t* choice, const With& with) {
    constexpr int order = Group<Mirror>::order;
    const Sizes s = sizes_of(layer);
    const int shift = layer.pool ? 1 : 0, fields = s.fields_out;
    const Map<order> map = {s.height_out >> shift, s.width_out >> shift};
    if (layer.pool)
        with([=](int block, int split) {
            const size_t i = offset_of(map, fields, block, split);
            return Unpooled<order>{map, gradient + i, choice + i};
        });
    else if (layer.relu)
        with([=](int block, int split) {
            const size_t i = offset_of(map, fields, block, split);
            return Masked<order>{map, gradient + i, y + i};
        });
    else
        with([=](int block, int split) {
            return Plain<order>{map, gradient + offset_of(map, fields, block, split)};
        });
}

template <bool Mirror>
void input_gradient(const Layer& layer, int blocks, const float* gradient, const float* y,
                    const uint8_t* choice, const float* weights, float* dx, int threads) {
    const Sizes s = adjoint(sizes_of(layer));
    const Map<Group<Mirror>::order> map = {s.height_out, s.width_out};
    large_pages(dx, blocks * map.size(s.fields_out) * sizeof(float));
    with_gradient<Mirror>(layer, gradient, y, choice, [&](const auto& source_of) {
        convolve<Mirror, true>(s, blocks, weights, threads, source_of, [&](int block, int split) {
            float* start = dx + offset_of(map, s.fields_out, block, split);
            return Target{start, nullptr, nullptr, false, false};
        });
    });
}

template <bool Mirror, bool Regular>
void weight_gradient(const Layer& layer, int blocks, const float* x, const float* gradient,
                     const float* y, const uint8_t* choice, float* weights, float* bias,
                     int threads) {
    const Sizes s = sizes_of(layer);
    constexpr int channels = Regular ? Group<Mirror>::order : 1;
    const Map<channels> map = {s.height_in, s.width_in};
    with_gradient<Mirror>(layer, gradient, y, choice, [&](const auto& gradient_of) {
        correlate_maps<Mirror, Regular>(
            s, blocks, weights, bias, threads,
            [&](int block, int split) {
                return Plain<channels>{map, x + offset_of(map, s.fields_in, block, split)};
            },
            gradient_of);
    });
}
#endif

}  // namespace

extern "C" {

#if defined(EQUIRL_ONE_IMAGE)

/// equirl_forward() for maps that hold one image each instead of sixteen; no choices.
void equirl_forward_one(const Layer* layer, int32_t images, const float* x, const float* weights,
                        const float* bias, float* y, int32_t threads) {
    call_forward(*layer, images, x, weights, bias, y, nullptr, threads);
}

#else

/// Changes with the signatures below and with the order of the rows of spectral.py; compared
/// with the number in library.py.
int32_t equirl_interface() { return 3; }

/// y = pool(relu(conv(x) + bias)); with `pool`, `choice` is written unless it is null.
void equirl_forward(const Layer* layer, int32_t blocks, const float* x, const float* weights,
                    const float* bias, float* y, uint8_t* choice, int32_t threads) {
    call_forward(*layer, blocks, x, weights, bias, y, choice, threads);
}

/// The gradient of x, for regular input; `weights` are those of the adjoint convolution.
void equirl_input_gradient(const Layer* layer, int32_t blocks, const float* gradient,
                           const float* y, const uint8_t* choice, const float* weights, float* dx,
                           int32_t threads) {
    const auto call = layer->order == 8 ? input_gradient<true> : input_gradient<false>;
    call(*layer, blocks, gradient, y, choice, weights, dx, threads);
}

/// The gradients of the weights and of the bias.
void equirl_weight_gradient(const Layer* layer, int32_t blocks, const float* x,
                            const float* gradient, const float* y, const uint8_t* choice,
                            float* weights, float* bias, int32_t threads) {
    const auto d4 = layer->regular ? weight_gradient<true, true> : weight_gradient<true, false>;
    const auto c4 = layer->regular ? weight_gradient<false, true> : weight_gradient<false, false>;
    (layer->order == 8 ? d4 : c4)(*layer, blocks, x, gradient, y, choice, weights, bias, threads);
}

#endif

}  // extern "C"
