// Vectors of images, and memory for them.

#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include <sys/mman.h>

namespace {

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

#if defined(EQUIRL_ONE_IMAGE)
inline Mask bits(Vec v) {
    Mask m;
    std::memcpy(&m, &v, sizeof m);
    return m;
}
inline Vec from_bits(Mask m) {
    Vec v;
    std::memcpy(&v, &m, sizeof v);
    return v;
}
#else
inline Mask bits(Vec v) { return (Mask)v; }
inline Vec from_bits(Mask m) { return (Vec)m; }
#endif

/// exp(x), to rounding; x is limited to where the result is a normal number.
inline Vec exponential(Vec x) {
    x = x > 87.0f ? Vec{} + 87.0f : x;
    x = x < -87.0f ? Vec{} - 87.0f : x;
    // x = k log 2 + r: the sum leaves the integer k in its lowest bits. log 2 comes in two parts,
    // of which k times the first is exact; exp(r), |r| < 0.35, is its Taylor series.
    constexpr float kInteger = 12582912.0f;  // 1.5 * 2^23, bits 0x4B400000
    const Vec shifted = x * 1.44269504088896341f + kInteger, k = shifted - kInteger;
    const Vec r = (x - k * 0.693359375f) + k * 2.12194440e-4f;
    Vec p = r * (1.0f / 5040) + 1.0f / 720;
    p = p * r + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r * r + r + 1.0f;
    return p * from_bits((bits(shifted) - 0x4B400000 + 127) << 23);
}

inline Vec sigmoid(Vec x) { return 1.0f / (1.0f + exponential(-x)); }

/// Memory that a thread keeps between calls; fresh pages cost more than the work on them.
template <int Purpose>
float* scratch(size_t floats) {
    struct Memory {
        float* start = nullptr;
        size_t size = 0;
        ~Memory() { std::free(start); }
    };
    static thread_local Memory memory;
    if (memory.size < floats) {
        std::free(memory.start);
        memory.size = (floats + 1023) & ~size_t(1023);
        memory.start = static_cast<float*>(std::aligned_alloc(64, memory.size * sizeof(float)));
        if (!memory.start) std::abort();
    }
    return memory.start;
}

/// Asks for large pages behind a new map. It is written once, and the kernel's work on small
/// pages can take longer than the writing. Advice only: it may be refused without harm.
inline void large_pages([[maybe_unused]] void* start, [[maybe_unused]] size_t bytes) {
#if defined(MADV_HUGEPAGE)
    constexpr uintptr_t kPage = 4096;
    const uintptr_t first = (uintptr_t(start) + kPage - 1) & ~(kPage - 1);
    const uintptr_t last = (uintptr_t(start) + bytes) & ~(kPage - 1);
    if (bytes >= (size_t(4) << 20)) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#endif
}

}  // namespace
