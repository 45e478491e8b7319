// Feature maps, the tiles they are computed by, and their spectral form.
//
// What is particular to a group is a `Space`: regular.hpp has C4 and D4, irreps.hpp SO(2) and O(2).

#pragma once

#include "vectors.hpp"

namespace {

/// Values of a tile's pixels in spectral form: part[irrep][row][component][pixel], for irreps of
/// one or two components. Odd strides keep rows apart in the cache.
struct Spectral {
    static constexpr int kMostIrreps = 5;
    Vec* part[kMostIrreps];
    int pixels;
    int stride(int dim) const { return dim * pixels | 1; }
};

/// Distances between rows and between pixels of the product of a matrix of that many rows.
struct Steps {
    int row, pixel;
};

struct Six {
    Vec centre, edge, square, cross, x, y;
};

/// The six pixel functions about p; x grows with the rows, y with the columns.
inline Six six(const Vec* p, int stride, float edge, float axis) {
    const Vec *u = p - stride, *d = p + stride;
    const Vec up = u[-1] + u[1], middle = p[-1] + p[1], down = d[-1] + d[1];
    const Vec up_y = u[1] - u[-1], middle_y = p[1] - p[-1], down_y = d[1] - d[-1];
    const Vec vertical = u[0] + d[0];
    return {p[0],
            (vertical + middle) + edge * (up + down),
            vertical - middle,
            edge * (down_y - up_y),
            (d[0] - u[0]) + axis * (down - up),
            middle_y + axis * (up_y + down_y)};
}

// ---- Feature maps -----------------------------------------------------------------------

struct Tile {
    int row, column, rows, columns;
    int pixels() const { return rows * columns; }
};

/// One block of images; Channels are those of a field.
template <int Channels>
struct Map {
    int height, width;
    size_t at(int field, int row, int column) const {
        return ((size_t(field) * height + row) * width + column) * (Channels * kBlock);
    }
    size_t size(int fields) const { return at(fields, 0, 0); }
    bool inside(int row, int column) const {
        return row >= 0 && row < height && column >= 0 && column < width;
    }
};

/// Calls use(pixel, channels) for the pixels of a tile, with the channels that read(offset)
/// gives inside of the map and zeros outside.
template <int Channels, class Read, class Use>
void each_pixel(const Map<Channels>& map, int field, const Tile& tile, const Read& read,
                const Use& use) {
    int pixel = 0;
    for (int i = tile.row; i < tile.row + tile.rows; ++i)
        for (int j = tile.column; j < tile.column + tile.columns; ++j, ++pixel) {
            Vec values[Channels] = {};
            if (map.inside(i, j))
                for (int c = 0; c < Channels; ++c)
                    values[c] = read(map.at(field, i, j) + c * kBlock);
            use(pixel, values);
        }
}

/// A map as it is.
template <int Channels>
struct Plain {
    Map<Channels> map;
    const float* x;
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        each_pixel(map, field, tile, [&](size_t k) { return load(x + k); }, use);
    }
};

/// The gradient before a ReLU, from that after it and the output.
template <int Channels>
struct Masked {
    Map<Channels> map;
    const float *gradient, *output;
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        const auto read = [&](size_t k) {
            return keep(~mask(load(output + k) <= 0), load(gradient + k));
        };
        each_pixel(map, field, tile, read, use);
    }
};

/// The gradient before a 2 x 2 maximum and a ReLU, from that after them and the choices.
template <int Channels>
struct Unpooled {
    Map<Channels> map;  // after the maximum
    const float* gradient;
    const uint8_t* choice;
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        const int bottom = tile.row + tile.rows, right = tile.column + tile.columns;
        // An arithmetic shift rounds down: row -1 is the lower half of the window -1.
        for (int i = tile.row >> 1; 2 * i < bottom; ++i)
            for (int j = tile.column >> 1; 2 * j < right; ++j) {
                Vec value[Channels] = {};
                Mask chosen[Channels] = {};
                if (map.inside(i, j))
                    for (int c = 0; c < Channels; ++c) {
                        const size_t k = map.at(field, i, j) + c * kBlock;
                        value[c] = load(gradient + k);
                        chosen[c] = load_bytes(choice + k);
                    }
                for (int q = 0; q < 4; ++q) {
                    const int row = 2 * i + q / 2, column = 2 * j + q % 2;
                    if (row < tile.row || row >= bottom || column < tile.column || column >= right)
                        continue;
                    Vec values[Channels];
                    for (int c = 0; c < Channels; ++c) values[c] = keep(mask(chosen[c] == q), value[c]);
                    use((row - tile.row) * tile.columns + column - tile.column, values);
                }
            }
    }
};

constexpr int kMaxRows = 2, kMaxColumns = 8;
constexpr int kMaxStrip = (kMaxRows + 2) * (kMaxColumns + 2);  // pixels of a tile and around it

/// The size of the tiles that divide a map; even where the map is, for the maximum.
inline Tile tile_of(int height, int width) {
    const int step = width % 2 ? 1 : 2;
    int columns = width < kMaxColumns ? width : kMaxColumns;
    while (width % columns) columns -= step;
    return {0, 0, height % kMaxRows ? 1 : kMaxRows, columns};
}

// ---- From a map to spectral tiles -------------------------------------------------------

/// Where the rows of one input field go.
template <class Space>
struct Rows {
    Vec* start[Space::irreps];
    int pixels, stride[Space::irreps];
    void single(int irrep, int row, int pixel, Vec value) const {
        start[irrep][row * stride[irrep] + pixel] = value;
    }
    void pair(int irrep, int row, int pixel, Vec first, Vec second) const {
        Vec* to = start[irrep] + row * stride[irrep] + pixel;
        to[0] = first, to[pixels] = second;
    }
    /// Where vectors are complex numbers: a row for v and one for i v.
    void both(int irrep, int row, int pixel, Vec first, Vec second) const {
        pair(irrep, 2 * row, pixel, first, second);
        pair(irrep, 2 * row + 1, pixel, -second, first);
    }
};

/// One part of an input field at the pixels of a tile and around them.
struct Strip {
    Vec values[kMaxStrip];
};

/// The six functions of some input fields at the pixels of a tile, as rows of each irrep.
template <class Space, class In, class Source>
void spectral_input(const Source& source, const Tile& tile, int padding, float edge, float axis,
                    int field, int count, const Spectral& v) {
    const Tile halo = {tile.row - padding, tile.column - padding, tile.rows + 2, tile.columns + 2};
    Strip parts[In::channels];
    int centre[kMaxRows * kMaxColumns];  // where the strips hold each pixel of the tile
    for (int i = 0, pixel = 0; i < tile.rows; ++i)
        for (int j = 0; j < tile.columns; ++j) centre[pixel++] = (i + 1) * halo.columns + j + 1;
    const auto functions = [&](int part, int pixel) {
        return six(parts[part].values + centre[pixel], halo.columns, edge, axis);
    };
    for (int f = 0; f < count; ++f) {
        source.each(field + f, halo, [&](int pixel, const Vec* values) {
            Vec at_pixel[In::channels];
            Space::transform(In{}, values, at_pixel);
            for (int c = 0; c < In::channels; ++c) parts[c].values[pixel] = at_pixel[c];
        });
        Rows<Space> rows;
        rows.pixels = v.pixels;
        for (int r = 0; r < Space::irreps; ++r) {
            rows.stride[r] = v.stride(Space::dim[r]);
            rows.start[r] = v.part[r] + size_t(f) * In::rows[r] * rows.stride[r];
        }
        Space::write_rows(In{}, functions, v.pixels, rows);
    }
}

/// The parts of every field at the pixels of a tile: row copy * fields + field of each irrep.
template <class Space, class Out, class Source>
void spectral_output(const Source& source, const Tile& tile, int fields, const Spectral& o) {
    for (int f = 0; f < fields; ++f)
        source.each(f, tile, [&](int pixel, const Vec* values) {
            Vec parts[Out::channels];
            Space::transform(Out{}, values, parts);
            const Vec* part = parts;
#pragma GCC unroll 8
            for (int r = 0; r < Space::irreps; ++r)
#pragma GCC unroll 8
                for (int c = 0; c < Out::copies[r]; ++c) {
                    Vec* row = o.part[r] + size_t(c * fields + f) * o.stride(Space::dim[r]) + pixel;
                    for (int d = 0; d < Space::dim[r]; ++d) row[d * o.pixels] = *part++;
                }
        });
}

/// The parts of one field at a pixel of a spectral tile that multiply() has written.
template <class Space, class Out>
inline void parts_at(const Spectral& o, const Steps* steps, int fields, int field, int pixel,
                     Vec* part) {
#pragma GCC unroll 8
    for (int r = 0; r < Space::irreps; ++r)
#pragma GCC unroll 8
        for (int c = 0; c < Out::copies[r]; ++c) {
            const Vec* row = o.part[r] + (c * fields + field) * steps[r].row + pixel * steps[r].pixel;
            for (int d = 0; d < Space::dim[r]; ++d) *part++ = row[d * o.pixels * steps[r].pixel];
        }
}

}  // namespace
