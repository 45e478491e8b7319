// Regular fields of D4 and C4: their Fourier transform, and the rows of their spectral input.

#pragma once

#include "fields.hpp"

namespace {

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

/// D4 (Mirror) or C4: one-dimensional irreps first, then the vector.
template <bool Mirror>
struct Regular {
    static constexpr int irreps = Mirror ? 5 : 3, singles = irreps - 1, vector = singles;
    static constexpr int dim[5] = {1, 1, Mirror ? 1 : 2, 1, 2};
    static constexpr bool mirror = Mirror, gated = false;

    /// An invariant channel; `rows` are those of each irrep's spectral input.
    struct Trivial {
        static constexpr int channels = 1;
        static constexpr int rows[5] = {2, Mirror ? 0 : 2, Mirror ? 1 : 2, 1, 1};
    };
    /// A regular field, in which the vector occurs `copies` times.
    struct Hidden {
        static constexpr int channels = Mirror ? 8 : 4;
        static constexpr int rows[5] = {6, 6, Mirror ? 6 : 12, 6, 12};
        static constexpr int copies[5] = {1, 1, 1, 1, 2};
    };
    using Output = Hidden;

    static void transform(Trivial, const Vec* values, Vec* parts) { parts[0] = values[0]; }
    static void transform(Hidden, const Vec* values, Vec* parts) {
        fourier<Mirror>(values, parts);
    }

    static void inverse(const Vec* parts, Vec* values) { ::inverse<Mirror>(parts, values); }

    template <class In, class Functions>
    static void write_rows(In, const Functions& functions, int pixels, const Rows<Regular>& rows) {
        constexpr bool regular = In::channels > 1;
        const auto pair = [&](int row, int pixel, Vec first, Vec second) {
            if constexpr (Mirror)
                rows.pair(vector, row, pixel, first, second);
            else
                rows.both(vector, row, pixel, first, second);
        };
#pragma GCC unroll 4
        for (int c = 0; c < (regular ? singles : 1); ++c) {
            // Multiplying by x^2 - y^2 or xy takes one irrep to another.
            const int square = Mirror ? c ^ 2 : c ^ 1, cross = Mirror ? c ^ 3 : c ^ 1;
            const int square_row = regular ? 2 : 0, cross_row = regular ? 3 : Mirror ? 0 : 1;
            const int row = !regular ? 0 : Mirror ? 8 + c : 4 + c;
            for (int pixel = 0; pixel < pixels; ++pixel) {
                const Six k = functions(c, pixel);
                rows.single(c, 0, pixel, k.centre);
                rows.single(c, 1, pixel, k.edge);
                rows.single(square, square_row, pixel, k.square);
                rows.single(cross, cross_row, pixel, k.cross);
                if (c == 0) pair(row, pixel, k.x, k.y);
                if (c == 1 && Mirror) pair(row, pixel, -k.y, k.x);
                if (c == 1 && !Mirror) pair(row, pixel, k.x, -k.y);
                if (c == 2) pair(row, pixel, k.x, -k.y);
                if (c == 3) pair(row, pixel, k.y, k.x);
            }
        }
        if constexpr (regular)
#pragma GCC unroll 2
            for (int c = 0; c < Hidden::copies[vector]; ++c)
                for (int pixel = 0; pixel < pixels; ++pixel) {
                    const Six a = functions(singles + 2 * c, pixel);
                    const Six b = functions(singles + 2 * c + 1, pixel);
                    pair(4 * c, pixel, a.centre, b.centre);
                    pair(4 * c + 1, pixel, a.edge, b.edge);
                    pair(4 * c + 2, pixel, a.square, -b.square);
                    pair(4 * c + 3, pixel, b.cross, a.cross);
                    const Vec dot = a.x + b.y, curl = b.x - a.y;
                    const Vec stretch = a.x - b.y, shear = b.x + a.y;
                    if constexpr (Mirror) {
                        rows.single(0, 4 + c, pixel, dot);
                        rows.single(1, 4 + c, pixel, curl);
                        rows.single(2, 4 + c, pixel, stretch);
                        rows.single(3, 4 + c, pixel, shear);
                    } else {
                        rows.single(0, 4, pixel, dot);
                        rows.single(0, 5, pixel, curl);
                        rows.single(1, 4, pixel, stretch);
                        rows.single(1, 5, pixel, shear);
                    }
                }
    }
};

}  // namespace
