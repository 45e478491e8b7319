// Fields of D4 and C4 in spectral form, and the feature maps they come from.

#pragma once

#include "vectors.hpp"

namespace {

/// A group: its one-dimensional irreps, and how often the vector occurs in a regular field.
template <bool Mirror>
struct Group {
    static constexpr int order = Mirror ? 8 : 4, singles = Mirror ? 4 : 2, copies = Mirror ? 2 : 1;
};

/// Rows of the spectral input per input field: for each one-dimensional irrep, the vector.
template <bool Mirror, bool Regular>
struct Rows {
    static constexpr int single[4] = {6, 6, 6, 6}, vector = 12;
};
template <>
struct Rows<true, false> {
    static constexpr int single[4] = {2, 0, 1, 1}, vector = 1;
};
template <>
struct Rows<false, false> {
    static constexpr int single[4] = {2, 2, 0, 0}, vector = 2;
};

/// Values of a tile's pixels in spectral form: single[irrep][row][pixel], and
/// vector[row][component][pixel]. Odd strides keep rows apart in the cache.
struct Spectral {
    Vec* single[4];
    Vec* vector;
    int pixels;
    int stride() const { return pixels | 1; }
    int stride2() const { return 2 * pixels | 1; }
};

/// Distances between rows and between pixels of the product of a matrix of that many rows.
struct Steps {
    int row, pixel;
};

/// One regular field at one pixel: singles, then the vectors' components.
template <bool Mirror>
inline void fourier(const Vec* f, Vec* s) {
    if constexpr (Mirror) {
        const Vec p0 = f[0] + f[4], p1 = f[1] + f[5], p2 = f[2] + f[6], p3 = f[3] + f[7];
        const Vec m0 = f[0] - f[4], m1 = f[1] - f[5], m2 = f[2] - f[6], m3 = f[3] - f[7];
        const Vec p02 = p0 + p2, p13 = p1 + p3, m02 = m0 + m2, m13 = m1 + m3;
        s[0] = p02 + p13, s[1] = m02 + m13, s[2] = p02 - p13, s[3] = m02 - m13;
        s[4] = p0 - p2, s[5] = p1 - p3, s[6] = m3 - m1, s[7] = m0 - m2;
    } else {
        const Vec even = f[0] + f[2], odd = f[1] + f[3];
        s[0] = even + odd, s[1] = even - odd, s[2] = f[0] - f[2], s[3] = f[1] - f[3];
    }
}

/// The transpose of fourier().
template <bool Mirror>
inline void inverse(const Vec* s, Vec* f) {
    if constexpr (Mirror) {
        const Vec pe = s[0] + s[2], po = s[0] - s[2], me = s[1] + s[3], mo = s[1] - s[3];
        const Vec p0 = pe + s[4], p2 = pe - s[4], p1 = po + s[5], p3 = po - s[5];
        const Vec m0 = me + s[7], m2 = me - s[7], m1 = mo - s[6], m3 = mo + s[6];
        f[0] = p0 + m0, f[1] = p1 + m1, f[2] = p2 + m2, f[3] = p3 + m3;
        f[4] = p0 - m0, f[5] = p1 - m1, f[6] = p2 - m2, f[7] = p3 - m3;
    } else {
        const Vec even = s[0] + s[1], odd = s[0] - s[1];
        f[0] = even + s[2], f[1] = odd + s[3], f[2] = even - s[2], f[3] = odd - s[3];
    }
}

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
            down_y - up_y,
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

constexpr int kMaxRows = 2, kMaxColumns = 8, kMaxPixels = kMaxRows * kMaxColumns;

/// The size of the tiles that divide a map; even where the map is, for the maximum.
inline Tile tile_of(int height, int width) {
    const int step = width % 2 ? 1 : 2;
    int columns = width < kMaxColumns ? width : kMaxColumns;
    while (width % columns) columns -= step;
    return {0, 0, height % kMaxRows ? 1 : kMaxRows, columns};
}

// ---- From a map to spectral tiles -------------------------------------------------------

/// The six functions of some input fields at the pixels of a tile, as rows of each irrep.
template <bool Mirror, bool Regular, class Source>
void spectral_input(const Source& source, const Tile& tile, int padding, float edge, float axis,
                    int field, int count, const Spectral& v) {
    using R = Rows<Mirror, Regular>;
    using G = Group<Mirror>;
    constexpr int channels = Regular ? G::order : 1;
    const int columns = tile.columns + 2;
    const Tile halo = {tile.row - padding, tile.column - padding, tile.rows + 2, columns};
    const int n = v.pixels, ld = v.stride(), ld2 = v.stride2();
    Vec strip[channels][(kMaxRows + 2) * (kMaxColumns + 2)];
    for (int f = 0; f < count; ++f) {
        source.each(field + f, halo, [&](int pixel, const Vec* values) {
            Vec parts[channels];
            if constexpr (Regular)
                fourier<Mirror>(values, parts);
            else
                parts[0] = values[0];
            for (int c = 0; c < channels; ++c) strip[c][pixel] = parts[c];
        });
        Vec* single[4];
        for (int s = 0; s < G::singles; ++s) single[s] = v.single[s] + size_t(f) * R::single[s] * ld;
        Vec* vector = v.vector + size_t(f) * R::vector * ld2;
        const auto pair = [&](int row, int pixel, Vec first, Vec second) {
            vector[row * ld2 + pixel] = first;
            vector[row * ld2 + n + pixel] = second;
        };
        // With the group C4 the vectors are complex numbers: a row for v and one for i v.
        const auto both = [&](int row, int pixel, Vec first, Vec second) {
            pair(2 * row, pixel, first, second);
            pair(2 * row + 1, pixel, -second, first);
        };
        for (int c = 0; c < (Regular ? G::singles : 1); ++c) {
            // Multiplying by x^2 - y^2 or xy takes one irrep to another.
            const int square = Mirror ? c ^ 2 : c ^ 1, cross = Mirror ? c ^ 3 : c ^ 1;
            for (int i = 0, pixel = 0; i < tile.rows; ++i)
                for (int j = 0; j < tile.columns; ++j, ++pixel) {
                    const Six k = six(&strip[c][(i + 1) * columns + j + 1], columns, edge, axis);
                    single[c][pixel] = k.centre;
                    single[c][ld + pixel] = k.edge;
                    if constexpr (Regular) {
                        single[square][2 * ld + pixel] = k.square;
                        single[cross][3 * ld + pixel] = k.cross;
                    } else if constexpr (Mirror) {
                        single[square][pixel] = k.square;
                        single[cross][pixel] = k.cross;
                    } else {
                        single[1][pixel] = k.square;
                        single[1][ld + pixel] = k.cross;
                    }
                    if constexpr (Mirror) {
                        const int row = Regular ? 8 + c : 0;
                        if (c == 0) pair(row, pixel, k.x, k.y);
                        if (c == 1) pair(row, pixel, -k.y, k.x);
                        if (c == 2) pair(row, pixel, k.x, -k.y);
                        if (c == 3) pair(row, pixel, k.y, k.x);
                    } else {
                        both(Regular ? 4 + c : 0, pixel, k.x, c ? -k.y : k.y);
                    }
                }
        }
        if constexpr (Regular)
            for (int c = 0; c < G::copies; ++c)
                for (int i = 0, pixel = 0; i < tile.rows; ++i)
                    for (int j = 0; j < tile.columns; ++j, ++pixel) {
                        const int p = (i + 1) * columns + j + 1;
                        const Vec* w = strip[G::singles + 2 * c];
                        const Six a = six(w + p, columns, edge, axis);
                        const Six b = six(strip[G::singles + 2 * c + 1] + p, columns, edge, axis);
                        const Vec dot = a.x + b.y, curl = b.x - a.y;
                        const Vec stretch = a.x - b.y, shear = b.x + a.y;
                        if constexpr (Mirror) {
                            pair(4 * c, pixel, a.centre, b.centre);
                            pair(4 * c + 1, pixel, a.edge, b.edge);
                            pair(4 * c + 2, pixel, a.square, -b.square);
                            pair(4 * c + 3, pixel, b.cross, a.cross);
                            const int row = (4 + c) * ld + pixel;
                            single[0][row] = dot, single[1][row] = curl;
                            single[2][row] = stretch, single[3][row] = shear;
                        } else {
                            both(0, pixel, a.centre, b.centre);
                            both(1, pixel, a.edge, b.edge);
                            both(2, pixel, a.square, -b.square);
                            both(3, pixel, b.cross, a.cross);
                            single[0][4 * ld + pixel] = dot, single[0][5 * ld + pixel] = curl;
                            single[1][4 * ld + pixel] = stretch;
                            single[1][5 * ld + pixel] = shear;
                        }
                    }
    }
}

/// The Fourier transform of every field at the pixels of a tile.
template <bool Mirror, class Source>
void spectral_output(const Source& source, const Tile& tile, int fields, const Spectral& o) {
    using G = Group<Mirror>;
    const int n = o.pixels, ld = o.stride(), ld2 = o.stride2();
    for (int f = 0; f < fields; ++f)
        source.each(f, tile, [&](int pixel, const Vec* values) {
            Vec s[G::order];
            fourier<Mirror>(values, s);
            for (int c = 0; c < G::singles; ++c) o.single[c][f * ld + pixel] = s[c];
            for (int c = 0; c < G::copies; ++c) {
                Vec* row = o.vector + size_t(c * fields + f) * ld2 + pixel;
                row[0] = s[G::singles + 2 * c], row[n] = s[G::singles + 2 * c + 1];
            }
        });
}

}  // namespace
