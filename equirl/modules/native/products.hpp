// Products of small matrices with spectral tiles, in registers.

#pragma once

#include "irreps.hpp"
#include "regular.hpp"

namespace {

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

}  // namespace
