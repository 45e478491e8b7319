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

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include <omp.h>
#include <sys/mman.h>

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

// ---- Vectors ----------------------------------------------------------------------------

#if defined(EQUIRL_ONE_IMAGE)
constexpr int kBlock = 1, kLanes = 1;
#else
constexpr int kBlock = 16;  // images side by side in memory
#if defined(__AVX512F__)
constexpr int kLanes = 16, kRows = 8, kColumns = 3;  // register tile: 24 of 32 registers
#elif defined(__AVX2__)
constexpr int kLanes = 8, kRows = 4, kColumns = 3;  // 12 of 16
#else
constexpr int kLanes = 4, kRows = 4, kColumns = 2;
#endif
#endif
constexpr int kSplits = kBlock / kLanes;  // vectors that make up one pixel of a block

#if defined(EQUIRL_ONE_IMAGE)
typedef float Vec;
typedef int32_t Mask;
inline Vec load(const float* p) { return *p; }
inline void store(float* p, Vec v) { *p = v; }
inline Mask load_bytes(const uint8_t* p) { return *p; }
inline void store_bytes(uint8_t* p, Mask v) { *p = uint8_t(v); }
inline Mask mask(bool condition) { return -Mask(condition); }
inline Vec keep(Mask mask, Vec v) { return mask ? v : 0; }
#else
typedef float Vec __attribute__((vector_size(4 * kLanes)));
typedef int32_t Mask __attribute__((vector_size(4 * kLanes)));
typedef uint8_t Bytes __attribute__((vector_size(kLanes)));
inline Vec load(const float* p) {
    Vec v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
inline void store(float* p, Vec v) { std::memcpy(p, &v, sizeof v); }
inline Mask load_bytes(const uint8_t* p) {
    Bytes bytes;
    std::memcpy(&bytes, p, sizeof bytes);
    return __builtin_convertvector(bytes, Mask);
}
inline void store_bytes(uint8_t* p, Mask v) {
    const Bytes bytes = __builtin_convertvector(v, Bytes);
    std::memcpy(p, &bytes, sizeof bytes);
}
inline Mask mask(Mask condition) { return condition; }
inline Vec keep(Mask mask, Vec v) { return (Vec)(mask & (Mask)v); }

/// Sums over lanes: lane l of the result is the sum of all lanes of v[l].
inline Vec sums(Vec* v) {
    constexpr int kFirst = kLanes / 2;
    Mask lane;
    for (int l = 0; l < kLanes; ++l) lane[l] = l;
#pragma GCC unroll 4
    for (int d = kFirst; d; d /= 2) {
        const Mask upper = (lane & d) != 0;
        const Mask first = lane + (upper & kLanes), second = (lane ^ d) + (upper & kLanes);
#pragma GCC unroll 16
        for (int i = 0; i < kLanes; ++i)
            if (!(i & d))
                v[i] = __builtin_shuffle(v[i], v[i + d], first) +
                       __builtin_shuffle(v[i], v[i + d], second);
    }
    return v[0];
}

#endif

/// Memory that a thread keeps between calls; fresh pages cost more than the work on them.
template <int Purpose>
float* scratch(size_t floats) {
    static thread_local float* memory = nullptr;
    static thread_local size_t size = 0;
    if (size < floats) {
        std::free(memory);
        size = (floats + 1023) & ~size_t(1023);
        memory = static_cast<float*>(std::aligned_alloc(64, size * sizeof(float)));
        if (!memory) std::abort();
    }
    return memory;
}

/// Asks for large pages behind a new map. It is written once, and the kernel's work on small
/// pages can take longer than the writing. Advice only: it may be refused without harm.
inline void large_pages(void* start, size_t bytes) {
    constexpr uintptr_t kPage = 4096;
    const uintptr_t first = (uintptr_t(start) + kPage - 1) & ~(kPage - 1);
    const uintptr_t last = (uintptr_t(start) + bytes) & ~(kPage - 1);
    if (bytes >= (size_t(4) << 20)) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
}

// ---- Fields -----------------------------------------------------------------------------

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

/// A map as it is. `each` calls use(pixel, channels) for the pixels of a tile of a field; they
/// are zero outside of the map.
template <int Channels>
struct Plain {
    Map<Channels> map;
    const float* x;
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        int pixel = 0;
        for (int i = tile.row; i < tile.row + tile.rows; ++i)
            for (int j = tile.column; j < tile.column + tile.columns; ++j, ++pixel) {
                Vec values[Channels] = {};
                if (map.inside(i, j))
                    for (int c = 0; c < Channels; ++c)
                        values[c] = load(x + map.at(field, i, j) + c * kBlock);
                use(pixel, values);
            }
    }
};

/// The gradient before a ReLU, from that after it and the output.
template <int Channels>
struct Masked {
    Map<Channels> map;
    const float *gradient, *output;
    template <class Use>
    void each(int field, const Tile& tile, const Use& use) const {
        int pixel = 0;
        for (int i = tile.row; i < tile.row + tile.rows; ++i)
            for (int j = tile.column; j < tile.column + tile.columns; ++j, ++pixel) {
                Vec values[Channels] = {};
                if (map.inside(i, j)) {
                    const size_t k = map.at(field, i, j);
                    for (int c = 0; c < Channels; ++c)
                        values[c] = keep(~mask(load(output + k + c * kBlock) <= 0),
                                         load(gradient + k + c * kBlock));
                }
                use(pixel, values);
            }
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

// ---- From a map to spectral tiles -----------------------------------------------------------

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

// ---- Matrix products ----------------------------------------------------------------------

#if defined(EQUIRL_ONE_IMAGE)
// One image leaves no lanes to fill: the vectors run over the rows of the matrix instead, and
// the products are stored pixel by pixel.

constexpr int kWide = 16;
#if defined(__AVX512F__)
constexpr int kAtOnce = 8;
#elif defined(__AVX2__)
constexpr int kAtOnce = 4;
#else
constexpr int kAtOnce = 2;
#endif
typedef float Wide __attribute__((vector_size(4 * kWide)));

inline int height_of(int) { return kWide; }
inline int padded(int m) { return (m + kWide - 1) & ~(kWide - 1); }
inline Steps steps_of(int m, int) { return {1, padded(m)}; }

/// out[N][16] (+)= weights[K][16] v[K][N], in registers.
template <int N>
void product(int k, const float* weights, const Vec* v, int ldv, Vec* out, int ldo, bool add) {
    Wide sum[N] = {};
    if (add)
#pragma GCC unroll 8
        for (int j = 0; j < N; ++j) std::memcpy(&sum[j], out + j * ldo, sizeof(Wide));
    for (; k; --k, weights += kWide, v += ldv) {
        Wide w;
        std::memcpy(&w, weights, sizeof w);
#pragma GCC unroll 8
        for (int j = 0; j < N; ++j) sum[j] += w * v[j];
    }
#pragma GCC unroll 8
    for (int j = 0; j < N; ++j) std::memcpy(out + j * ldo, &sum[j], sizeof(Wide));
}

template <int N>
void product_n(int n, int k, const float* w, const Vec* v, int ldv, Vec* o, int ldo, bool add) {
    for (; n >= N; n -= N, v += N, o += N * ldo) product<N>(k, w, v, ldv, o, ldo, add);
    if constexpr (N > 1) product_n<N / 2>(n, k, w, v, ldv, o, ldo, add);
}

/// out[n][m] (+)= the rows [k0, k0 + k) of packed weights [K][m] times v[k][n].
void multiply(int m, int n, int k, int k0, int K, const float* weights, const Vec* v, int ldv,
              Vec* out, bool add) {
    const int ldo = padded(m);
    if (k == 0 && !add) std::memset(out, 0, size_t(n) * ldo * sizeof(Vec));
    if (k == 0) return;
    for (int i = 0; i < m; i += kWide)
        product_n<kAtOnce>(n, k, weights + size_t(i) * K + size_t(k0) * kWide, v, ldv, out + i,
                           ldo, add);
}
#else
inline int padded(int m) { return m; }
inline Steps steps_of(int, int stride) { return {stride, 1}; }

/// out[M][N] (+)= weights[K][M] v[K][N], in registers.
template <int M, int N>
void product(int k, const float* weights, const Vec* v, int ldv, Vec* out, int ldo, bool add) {
    Vec sum[M][N];
#pragma GCC unroll 8
    for (int i = 0; i < M; ++i)
#pragma GCC unroll 4
        for (int j = 0; j < N; ++j) sum[i][j] = add ? out[i * ldo + j] : Vec{};
    for (; k; --k, weights += M, v += ldv) {
        Vec column[N];
#pragma GCC unroll 4
        for (int j = 0; j < N; ++j) column[j] = v[j];
#pragma GCC unroll 8
        for (int i = 0; i < M; ++i) {
            const float w = weights[i];
#pragma GCC unroll 4
            for (int j = 0; j < N; ++j) sum[i][j] += w * column[j];
        }
    }
#pragma GCC unroll 8
    for (int i = 0; i < M; ++i)
#pragma GCC unroll 4
        for (int j = 0; j < N; ++j) out[i * ldo + j] = sum[i][j];
}

/// Heights of the register tiles that add up to m, the largest first.
inline int height_of(int m) {
    int height = kRows;
    while (height > m) height /= 2;
    return height;
}

/// Widths of the register tiles that add up to n, as even as can be.
inline int width_of(int n) {
    if (kColumns == 3) return n == 4 || n == 2 ? 2 : n >= 3 ? 3 : 1;
    return n >= 2 ? 2 : 1;
}

template <int M>
void product_n(int n, int k, const float* w, const Vec* v, int ldv, Vec* o, int ldo, bool add) {
    if (n == 1) product<M, 1>(k, w, v, ldv, o, ldo, add);
    if (n == 2) product<M, 2>(k, w, v, ldv, o, ldo, add);
    if constexpr (kColumns == 3)
        if (n == 3) product<M, 3>(k, w, v, ldv, o, ldo, add);
}

/// out[m][n] (+)= the rows [k0, k0 + k) of packed weights [K][m] times v[k][n].
void multiply(int m, int n, int k, int k0, int K, const float* weights, const Vec* v, int ldv,
              Vec* out, bool add) {
    const int ldo = ldv;
    if (k == 0) {
        if (!add)
            for (int i = 0; i < m; ++i) std::memset(out + i * ldo, 0, n * sizeof(Vec));
        return;
    }
    for (int j = 0, width; j < n; j += width) {
        width = width_of(n - j);
        for (int i = 0, height; i < m; i += height) {
            height = height_of(m - i);
            const float* w = weights + size_t(i) * K + size_t(k0) * height;
            Vec* o = out + size_t(i) * ldo + j;
            if (height == 8) product_n<kRows == 8 ? 8 : 4>(width, k, w, v + j, ldv, o, ldo, add);
            if (height == 4) product_n<4>(width, k, w, v + j, ldv, o, ldo, add);
            if (height == 2) product_n<2>(width, k, w, v + j, ldv, o, ldo, add);
            if (height == 1) product_n<1>(width, k, w, v + j, ldv, o, ldo, add);
        }
    }
}

/// sums[i / 4][j / 4][4][4] += the products over pixels and lanes of rows a[i] and b[j].
void correlate(int m, int k, int n, const Vec* a, int lda, const Vec* b, int ldb, float* out,
               int blocks) {
    for (int j = 0; j < k; j += 4)
        for (int i = 0; i < m; i += 4) {
            const Vec *pa = a + size_t(i) * lda, *pb = b + size_t(j) * ldb;
            Vec sum[16] = {};
            for (int t = 0; t < n; ++t, ++pa, ++pb) {
                const Vec b0 = pb[0], b1 = pb[ldb], b2 = pb[2 * ldb], b3 = pb[3 * ldb];
#pragma GCC unroll 4
                for (int r = 0; r < 4; ++r) {
                    const Vec x = pa[r * lda];
                    sum[4 * r] += x * b0, sum[4 * r + 1] += x * b1;
                    sum[4 * r + 2] += x * b2, sum[4 * r + 3] += x * b3;
                }
            }
            float* o = out + (size_t(i / 4) * blocks + j / 4) * 16;
#pragma GCC unroll 4
            for (int s = 0; s < 16; s += kLanes) store(o + s, load(o + s) + sums(sum + s));
        }
}

#endif

// ---- Layers -----------------------------------------------------------------------------

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

constexpr size_t kCache = 400 << 10;  // bytes of spectral input at a time

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
        const size_t in_size = lay_out_input<Mirror, Regular>(nullptr, n, chunk, &v);
        const size_t out_size = lay_out_output<Mirror>(nullptr, n, s.fields_out, &o);
        float* memory = scratch<1>(in_size + out_size);
        lay_out_input<Mirror, Regular>(memory, n, chunk, &v);
        lay_out_output<Mirror>(memory + in_size, n, s.fields_out, &o);
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

/// Gradients of the weights and the bias. Work is divided into a fixed number of parts,
/// summed in order: the result does not depend on the number of threads.
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
        const size_t in_size = lay_out_input<Mirror, Regular>(nullptr, n, chunk, &v);
        const size_t out_size = lay_out_output<Mirror>(nullptr, n, co, &o);
        float* memory = scratch<1>(in_size + out_size);
        lay_out_input<Mirror, Regular>(memory, n, chunk, &v);
        lay_out_output<Mirror>(memory + in_size, n, co, &o);
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

/// Changes with the signatures of this file; compared with the number in library.py.
int32_t equirl_interface() { return 2; }

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
