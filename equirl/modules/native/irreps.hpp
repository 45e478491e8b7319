// Fields of SO(2) and O(2): irreps to frequency 3, their spectral input, and their gates.
//
// A vector of frequency k, as a complex number, is multiplied by exp(i k angle) when the scene
// turns, and conjugated when it is reflected. So are the pixel functions: the centre and the
// edges have frequency 0, (x, y) has 1 and (x^2 - y^2, 2 x y) has 2. Products of the two, one of
// them conjugated or not, are vectors of the sum and of the difference of the frequencies.

#pragma once

#include "fields.hpp"

namespace {

/// O(2) (Mirror) or SO(2): the trivial irrep, O(2)'s sign, the vectors of frequency 1 to 3.
template <bool Mirror>
struct Irreducible {
    static constexpr int irreps = Mirror ? 5 : 4, sign = 1, vectors = irreps - 3;
    static constexpr int dim[5] = {1, Mirror ? 1 : 2, 2, 2, 2};
    static constexpr bool mirror = Mirror, gated = true;
    static constexpr int gates = irreps;  // one for each irrep of a hidden field

    /// Rows of the spectral input of fields with some trivial parts.
    template <int Trivials, bool Rest>
    struct Fields {
        static constexpr int trivials = Trivials, channels = Trivials + (Rest ? irreps + 2 : 0);
        static constexpr bool rest = Rest;
        // Without reflections a vector has a row for v and one for i v.
        static constexpr int each = Mirror ? 1 : 2, t = Trivials;
        static constexpr int one = 2 * t + (Rest ? (Mirror ? 2 : 4) : 0);
        static constexpr int v1 = each * (t + (Rest ? (Mirror ? 6 : 5) : 0));
        static constexpr int v2 = each * (t + (Rest ? (Mirror ? 5 : 4) : 0));
        static constexpr int v3 = each * (Rest ? 4 : 0);
        static constexpr int rows[5] = {one, Mirror ? (Rest ? 4 : 0) : v1, Mirror ? v1 : v2,
                                        Mirror ? v2 : v3, v3};
        static constexpr int copies[5] = {t, 1, 1, 1, 1};
    };
    using Trivial = Fields<1, false>;
    using Hidden = Fields<1, true>;
    /// What a convolution gives: the trivial part, the gates of all parts, the other parts.
    using Output = Fields<1 + gates, true>;

    template <class In>
    static void transform(In, const Vec* values, Vec* parts) {
        for (int c = 0; c < In::channels; ++c) parts[c] = values[c];
    }

    static void inverse(const Vec* parts, Vec* values) {
        for (int c = 0; c < Hidden::channels; ++c) values[c] = parts[c];
    }

    template <class In, class Functions>
    static void write_rows(In, const Functions& functions, int pixels,
                           const Rows<Irreducible>& rows) {
        int taken[irreps] = {};
        const auto take = [&](int irrep, int count) {
            taken[irrep] += count;
            return taken[irrep] - count;
        };
        const auto pair = [&](int irrep, int row, int pixel, Vec first, Vec second) {
            if constexpr (Mirror)
                rows.pair(irrep, row, pixel, first, second);
            else
                rows.both(irrep, row, pixel, first, second);
        };
        constexpr int v1 = vectors, v2 = vectors + 1, v3 = vectors + 2;
        for (int c = 0; c < In::trivials; ++c) {
            const int one = take(0, 2), first = take(v1, 1), second = take(v2, 1);
            for (int pixel = 0; pixel < pixels; ++pixel) {
                const Six k = functions(c, pixel);
                rows.single(0, one, pixel, k.centre);
                rows.single(0, one + 1, pixel, k.edge);
                pair(v1, first, pixel, k.x, k.y);
                pair(v2, second, pixel, k.square, k.cross);
            }
        }
        if constexpr (!In::rest) return;
        int channel = In::trivials;
        if constexpr (Mirror) {
            const int odd = take(sign, 2), first = take(v1, 1), second = take(v2, 1);
            for (int pixel = 0; pixel < pixels; ++pixel) {
                const Six k = functions(channel, pixel);
                rows.single(sign, odd, pixel, k.centre);
                rows.single(sign, odd + 1, pixel, k.edge);
                pair(v1, first, pixel, -k.y, k.x);
                pair(v2, second, pixel, -k.cross, k.square);
            }
            ++channel;
        }
        for (int k = 1; k <= 3; ++k, channel += 2) {
            const int same = take(vectors + k - 1, 2);
            // The real part of a product of equal frequencies is invariant, the imaginary part odd.
            const int even = k < 3 ? take(0, 1) : 0;
            const int odd = k < 3 ? take(Mirror ? sign : 0, 1) : 0;
            const int row_a = k == 1 ? take(v1, 1) : k == 2 ? take(v1, 1) : take(v2, 1);
            const int row_b = k == 1 ? take(v2, 1) : k == 2 ? take(v3, 1) : take(v1, 1);
            const int row_c = k == 1 ? take(v3, 1) : 0;
            for (int pixel = 0; pixel < pixels; ++pixel) {
                const Six a = functions(channel, pixel), b = functions(channel + 1, pixel);
                pair(vectors + k - 1, same, pixel, a.centre, b.centre);
                pair(vectors + k - 1, same + 1, pixel, a.edge, b.edge);
                const Vec dot_1 = a.x + b.y, curl_1 = b.x - a.y;
                const Vec dot_2 = a.square + b.cross, curl_2 = b.square - a.cross;
                if (k == 1) {
                    rows.single(0, even, pixel, dot_1);
                    rows.single(Mirror ? sign : 0, odd, pixel, curl_1);
                    pair(v1, row_a, pixel, dot_2, -curl_2);
                    pair(v2, row_b, pixel, a.x - b.y, a.y + b.x);
                    pair(v3, row_c, pixel, a.square - b.cross, a.cross + b.square);
                } else if (k == 2) {
                    rows.single(0, even, pixel, dot_2);
                    rows.single(Mirror ? sign : 0, odd, pixel, curl_2);
                    pair(v1, row_a, pixel, dot_1, curl_1);
                    pair(v3, row_b, pixel, a.x - b.y, a.y + b.x);
                } else {
                    pair(v2, row_a, pixel, dot_1, curl_1);
                    pair(v1, row_b, pixel, dot_2, curl_2);
                }
            }
        }
    }
};

// ---- Gates and the pooling of vectors ---------------------------------------------------

/// How a layer pools 2 x 2 pixels: not at all; by maximum, of vectors the first of largest norm;
/// of vectors the mean, weighted by the fourth power of the norms.
enum Pool { kNone = 0, kMaximum = 1, kShared = 2 };

constexpr float kEpsilon = 1e-12f;  // of squared norms

/// A hidden field before its gates, and the gates after their sigmoid: the channels of a raw map.
template <bool Mirror>
struct Gated {
    using Space = Irreducible<Mirror>;
    static constexpr int parts = Space::irreps, channels = Space::Hidden::channels;
    static constexpr int raw = channels + parts;
    Vec field[channels], gate[parts];

    /// From the parts of Space::Output: the trivial one, the gates, the others.
    static Gated of(const Vec* output) {
        Gated g;
        g.field[0] = output[0];
        for (int r = 0; r < parts; ++r) g.gate[r] = sigmoid(output[1 + r]);
        for (int c = 1; c < channels; ++c) g.field[c] = output[parts + c];
        return g;
    }
    static Gated read(const float* map) {
        Gated g;
        for (int c = 0; c < channels; ++c) g.field[c] = load(map + c * kBlock);
        for (int r = 0; r < parts; ++r) g.gate[r] = load(map + (channels + r) * kBlock);
        return g;
    }
    void write(float* map) const {
        for (int c = 0; c < channels; ++c) store(map + c * kBlock, field[c]);
        for (int r = 0; r < parts; ++r) store(map + (channels + r) * kBlock, gate[r]);
    }
    /// The gated field.
    void values(Vec* v) const {
        for (int r = 0, c = 0; r < parts; ++r)
            for (int d = 0; d < Space::dim[r]; ++d, ++c) v[c] = field[c] * gate[r];
    }
    /// The gradient before the gates, as parts of Space::Output, from that of the gated field.
    void backward(const Vec* gradient, Vec* output) const {
        for (int r = 0, c = 0; r < parts; ++r) {
            Vec dot = {};
            for (int d = 0; d < Space::dim[r]; ++d, ++c) {
                output[c ? parts + c : 0] = gradient[c] * gate[r];
                dot += gradient[c] * field[c];
            }
            output[1 + r] = dot * gate[r] * (1 - gate[r]);
        }
    }
};

/// Squared norms of the parts of a field.
template <class Space>
inline void squared_norms(const Vec* v, Vec* norms) {
    for (int r = 0; r < Space::irreps; ++r) {
        norms[r] = *v * *v;
        ++v;
        if (Space::dim[r] == 2) norms[r] += *v * *v, ++v;
    }
}

/// The largest of four squared norms of a part. Weights are relative to it, as it cancels and the
/// fourth power of a norm may overflow.
template <class Space>
inline Vec largest_of(const Vec (*norms)[Space::irreps], int part) {
    Vec largest = norms[0][part];
    for (int q = 1; q < 4; ++q) largest = norms[q][part] > largest ? norms[q][part] : largest;
    return largest;
}

/// Pools four fields.
template <bool Mirror>
inline void pool_vectors(int pool, const Vec (*v)[Gated<Mirror>::channels], Vec* pooled) {
    using Space = Irreducible<Mirror>;
    Vec norms[4][Space::irreps];
    for (int q = 0; q < 4; ++q) squared_norms<Space>(v[q], norms[q]);
    for (int r = 0, c = 0; r < Space::irreps; ++r)
        if (pool == kMaximum) {
            Vec best[2] = {v[0][c], v[0][c + Space::dim[r] - 1]}, largest = norms[0][r];
            for (int q = 1; q < 4; ++q) {
                const Mask better = mask((norms[q][r] > largest) | (norms[q][r] != norms[q][r]));
                largest = better ? norms[q][r] : largest;
                for (int d = 0; d < Space::dim[r]; ++d) best[d] = better ? v[q][c + d] : best[d];
            }
            for (int d = 0; d < Space::dim[r]; ++d) pooled[c++] = best[d];
        } else {
            Vec weight[4], total = {};
            const Vec scale = 1.0f / (largest_of<Space>(norms, r) + kEpsilon);
            for (int q = 0; q < 4; ++q) {
                const Vec relative = (norms[q][r] + kEpsilon) * scale;
                weight[q] = relative * relative;
                total += weight[q];
            }
            const Vec inverse = 1.0f / total;
            for (int d = 0; d < Space::dim[r]; ++d, ++c) {
                Vec sum = {};
                for (int q = 0; q < 4; ++q) sum += weight[q] * v[q][c];
                pooled[c] = sum * inverse;
            }
        }
}

/// The gradients of four fields from that of the pooled one.
template <bool Mirror>
inline void unpool_vectors(int pool, const Vec (*v)[Gated<Mirror>::channels], const Vec* gradient,
                           Vec (*dv)[Gated<Mirror>::channels]) {
    using Space = Irreducible<Mirror>;
    Vec norms[4][Space::irreps];
    for (int q = 0; q < 4; ++q) squared_norms<Space>(v[q], norms[q]);
    for (int r = 0, c = 0; r < Space::irreps; c += Space::dim[r], ++r)
        if (pool == kMaximum) {
            Mask chosen = {};
            Vec largest = norms[0][r];
            for (int q = 1; q < 4; ++q) {
                const Mask better = mask((norms[q][r] > largest) | (norms[q][r] != norms[q][r]));
                largest = better ? norms[q][r] : largest;
                chosen = better ? chosen - chosen + q : chosen;
            }
            for (int q = 0; q < 4; ++q)
                for (int d = c; d < c + Space::dim[r]; ++d)
                    dv[q][d] = keep(mask(chosen == q), gradient[d]);
        } else {
            // With weights w = t / sum t, t = s^2 and s = |v|^2 + epsilon, and p the pooled vector:
            // dv = w (gradient + 4 v ((v - p) . gradient) / s).
            Vec share[4], dot[4], total = {}, mean = {};
            const Vec scale = 1.0f / (largest_of<Space>(norms, r) + kEpsilon);
            for (int q = 0; q < 4; ++q) {
                norms[q][r] += kEpsilon;
                share[q] = norms[q][r] * scale * (norms[q][r] * scale);
                total += share[q];
                dot[q] = v[q][c] * gradient[c];
                if (Space::dim[r] == 2) dot[q] += v[q][c + 1] * gradient[c + 1];
            }
            const Vec inverse = 1.0f / total;
            for (int q = 0; q < 4; ++q) {
                share[q] *= inverse;
                mean += share[q] * dot[q];
            }
            for (int q = 0; q < 4; ++q) {
                const Vec along = 4 * (dot[q] - mean) / norms[q][r];
                for (int d = c; d < c + Space::dim[r]; ++d)
                    dv[q][d] = share[q] * (gradient[d] + along * v[q][d]);
            }
        }
}

/// The gradient before gates and pooling, from that after them and the raw map.
template <bool Mirror>
struct Ungated {
    using Field = Gated<Mirror>;
    Map<Field::channels> map;  // after the pooling
    Map<Field::raw> all;
    const float *gradient, *raw;
    int pool;
    /// As the other sources, for tiles that lie within the map and divide no window.
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        const int step = pool ? 2 : 1;
        for (int i = 0; i < tile.rows; i += step)
            for (int j = 0; j < tile.columns; j += step) {
                const int row = tile.row + i, column = tile.column + j;
                Vec pooled[Field::channels], values[4][Field::channels], slope[4][Field::channels];
                const float* from = gradient + map.at(field, row / step, column / step);
                for (int c = 0; c < Field::channels; ++c) pooled[c] = load(from + c * kBlock);
                Field fields[4];
                for (int q = 0; q < step * step; ++q) {
                    fields[q] = Field::read(raw + all.at(field, row + q / 2, column + q % 2));
                    if (pool) fields[q].values(values[q]);
                }
                if (pool) unpool_vectors<Mirror>(pool, values, pooled, slope);
                for (int q = 0; q < step * step; ++q) {
                    Vec before[Field::raw];
                    fields[q].backward(pool ? slope[q] : pooled, before);
                    use((i + q / 2) * tile.columns + j + q % 2, before);
                }
            }
    }
};

}  // namespace
