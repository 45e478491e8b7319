// What becomes of the products of a tile: bias, activation and pooling, and the way to the map.

#pragma once

#include "products.hpp"

namespace {

/// Sizes of one convolution.
struct Sizes {
    int fields_in, fields_out;
    int height_in, width_in, height_out, width_out, padding;
    float edge, axis;
};

/// What becomes of the result of a convolution.
struct Target {
    float* map;
    uint8_t* choice;    // of the maximum, 0 to 3, or 4 where the ReLU blocked; may be null
    float* raw;         // fields and gates before they are multiplied; may be null
    const float* bias;  // [copy of the trivial part][field], or null
    int pool;
    bool activation;
};

/// Bias, pooling and activation of a tile of regular fields, or of irreducible ones as they are.
template <class Space, class Out>
void finish_plain(const Target& target, const Sizes& s, const Tile& tile, const Spectral& o,
                  const Steps* steps) {
    const int shift = target.pool ? 1 : 0;
    const Map<Out::channels> map = {s.height_out >> shift, s.width_out >> shift};
    const auto field_at = [&](int f, int pixel, Vec* values) {
        Vec parts[Out::channels];
        parts_at<Space, Out>(o, steps, s.fields_out, f, pixel, parts);
        if (target.bias) parts[0] += target.bias[f];
        Space::inverse(parts, values);
    };
    for (int f = 0; f < s.fields_out; ++f)
        for (int i = 0; i < tile.rows >> shift; ++i)
            for (int j = 0; j < tile.columns >> shift; ++j) {
                const size_t k = map.at(f, (tile.row >> shift) + i, (tile.column >> shift) + j);
                if (!target.pool) {
                    Vec values[Out::channels];
                    field_at(f, i * tile.columns + j, values);
                    for (int c = 0; c < Out::channels; ++c) {
                        const Vec v = values[c];
                        store(target.map + k + c * kBlock,
                              target.activation ? keep(~mask(v < 0), v) : v);
                    }
                    continue;
                }
                Vec values[4][Out::channels];
                for (int q = 0; q < 4; ++q)
                    field_at(f, (2 * i + q / 2) * tile.columns + 2 * j + q % 2, values[q]);
                for (int c = 0; c < Out::channels; ++c) {
                    Vec best = values[0][c];
                    Mask choice = {};
                    for (int q = 1; q < 4; ++q) {
                        const Vec v = values[q][c];
                        const Mask better = mask((v > best) | (v != v));  // not a number wins
                        best = better ? v : best;
                        choice = better ? choice - choice + q : choice;
                    }
                    if (target.activation) {
                        const Mask dead = mask(best <= 0);
                        best = keep(~dead, best);
                        choice = dead ? choice - choice + 4 : choice;
                    }
                    store(target.map + k + c * kBlock, best);
                    if (target.choice) store_bytes(target.choice + k + c * kBlock, choice);
                }
            }
}

/// Bias, gates and pooling of a tile of irreducible fields.
template <bool Mirror>
void finish_gated(const Target& target, const Sizes& s, const Tile& tile, const Spectral& o,
                  const Steps* steps) {
    using Space = Irreducible<Mirror>;
    using Out = typename Space::Output;
    using Field = Gated<Mirror>;
    const int shift = target.pool ? 1 : 0;
    const Map<Field::channels> map = {s.height_out >> shift, s.width_out >> shift};
    const Map<Field::raw> raw = {s.height_out, s.width_out};
    const auto field_at = [&](int f, int i, int j, Vec* values) {
        Vec parts[Out::channels];
        parts_at<Space, Out>(o, steps, s.fields_out, f, i * tile.columns + j, parts);
        for (int c = 0; c < Out::trivials; ++c) parts[c] += target.bias[c * s.fields_out + f];
        const Field field = Field::of(parts);
        if (target.raw) field.write(target.raw + raw.at(f, tile.row + i, tile.column + j));
        field.values(values);
    };
    for (int f = 0; f < s.fields_out; ++f)
        for (int i = 0; i < tile.rows >> shift; ++i)
            for (int j = 0; j < tile.columns >> shift; ++j) {
                Vec values[4][Field::channels], pooled[Field::channels];
                if (target.pool) {
                    for (int q = 0; q < 4; ++q) field_at(f, 2 * i + q / 2, 2 * j + q % 2, values[q]);
                    pool_vectors<Mirror>(target.pool, values, pooled);
                } else {
                    field_at(f, i, j, pooled);
                }
                const size_t k = map.at(f, (tile.row >> shift) + i, (tile.column >> shift) + j);
                for (int c = 0; c < Field::channels; ++c) store(target.map + k + c * kBlock, pooled[c]);
            }
}

}  // namespace
