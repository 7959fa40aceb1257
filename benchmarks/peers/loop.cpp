// The machine's own limit: emission and absorption along rays, with the shortcuts of a good volume renderer and nothing else.
// Voxels have 16 bits and lie brick by brick, so that a ray stays in few cache lines; the transfer function is multiplied out for the
// step; rays skip bricks that are empty under it and end once nothing behind can be seen.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <thread>
#include <vector>

namespace {

typedef float Float4 __attribute__((vector_size(16)));
typedef float Float8 __attribute__((vector_size(32)));
typedef int Int4 __attribute__((vector_size(16)));
typedef int Int8 __attribute__((vector_size(32)));
typedef uint16_t Short8 __attribute__((vector_size(16)));

constexpr int LOG_BRICK = 2, BRICK = 1 << LOG_BRICK;  // cells a side
constexpr int SIDE = BRICK + 1, STRIDE = 128;          // voxels of a brick, a side and in memory
constexpr int TILE = 8;                                // pixels a side, so that neighbouring rays share the cache

struct Volume {
    int n[3], bricks[3];
    std::vector<uint16_t> voxels;           // brick by brick, each with its far faces, so that all corners of a cell are near each other
    std::vector<uint16_t> lowest, highest;  // of each brick
    std::vector<uint8_t> distance;          // to the nearest brick that is not empty, in bricks, 0 inside; largest of the three axes
    std::vector<Float4> table;              // red, green, blue, each times the opacity of a step; opacity
    int shift;                              // from a voxel to an entry of the table

    size_t brick(int a, int b, int c) const { return (size_t(a) * bricks[1] + b) * bricks[2] + c; }
};

void pack(Volume& v, const uint16_t* voxels) {
    const size_t count = size_t(v.bricks[0]) * v.bricks[1] * v.bricks[2];
    v.voxels.resize(count * STRIDE);
    v.lowest.resize(count);
    v.highest.resize(count);
    for (int a = 0; a < v.bricks[0]; a++)
        for (int b = 0; b < v.bricks[1]; b++)
            for (int c = 0; c < v.bricks[2]; c++) {
                uint16_t* out = &v.voxels[v.brick(a, b, c) * STRIDE];
                for (int e = 0; e < SIDE * SIDE * SIDE; e++) {
                    const int i = std::min(a * BRICK + e / (SIDE * SIDE), v.n[0] - 1);
                    const int j = std::min(b * BRICK + e / SIDE % SIDE, v.n[1] - 1);
                    const int k = std::min(c * BRICK + e % SIDE, v.n[2] - 1);
                    out[e] = voxels[(size_t(i) * v.n[1] + j) * v.n[2] + k];
                }
                const auto range = std::minmax_element(out, out + SIDE * SIDE * SIDE);
                v.lowest[v.brick(a, b, c)] = *range.first;
                v.highest[v.brick(a, b, c)] = *range.second;
            }
}

// One axis of the chessboard distance: min over the line of max(|i - j|, distance[j]), by growing the neighbours' distances.
void spread(std::vector<uint8_t>& d, size_t start, size_t stride, int count, std::vector<uint8_t>& line) {
    for (int i = 0; i < count; i++) line[i] = d[start + i * stride];
    for (int i = 0; i < count; i++) {
        int best = line[i];
        for (int r = 1; r < best; r++)
            best = std::min(best, std::max(r, int(std::min(i >= r ? line[i - r] : 255, i + r < count ? line[i + r] : 255))));
        d[start + i * stride] = uint8_t(best);
    }
}

void find_empty(Volume& v) {
    std::vector<int> filled(v.table.size() + 1, 0);
    for (size_t e = 0; e < v.table.size(); e++) filled[e + 1] = filled[e] + (v.table[e][3] > 0);
    v.distance.resize(v.lowest.size());
    for (size_t b = 0; b < v.distance.size(); b++)
        v.distance[b] = filled[(v.highest[b] >> v.shift) + 1] > filled[v.lowest[b] >> v.shift] ? 0 : 255;
    const int* m = v.bricks;
    std::vector<uint8_t> line(std::max({m[0], m[1], m[2]}));
    for (int a = 0; a < m[0]; a++)
        for (int b = 0; b < m[1]; b++) spread(v.distance, v.brick(a, b, 0), 1, m[2], line);
    for (int a = 0; a < m[0]; a++)
        for (int c = 0; c < m[2]; c++) spread(v.distance, v.brick(a, 0, c), m[2], m[1], line);
    for (int b = 0; b < m[1]; b++)
        for (int c = 0; c < m[2]; c++) spread(v.distance, v.brick(0, b, c), size_t(m[1]) * m[2], m[0], line);
}

// The first sample at or behind `k` that may not be empty, as far as the nearest brick that is not allows to skip.
inline int skip(Int4 brick, int d, const float* entry, const float* inverse, float step, int k) {
    float exit = 1e30f;
    for (int axis = 0; axis < 3; axis++) {
        const float face = inverse[axis] > 0 ? float((brick[axis] + d) * BRICK) : float((brick[axis] - d + 1) * BRICK);
        exit = std::min(exit, (face - entry[axis]) * inverse[axis]);
    }
    return std::max(k + 1, int(std::ceil(exit / step - 0.5f)));
}

// The scalar at a point of a brick, from the eight voxels around it.
inline float interpolate(const uint16_t* brick, Int4 cell, Float4 f) {
    const uint16_t* at = brick + (cell[0] * SIDE + cell[1]) * SIDE + cell[2];
    auto pair = [&](int offset) {
        int two;
        std::memcpy(&two, at + offset, 4);
        return two;
    };
    const Int4 pairs = {pair(0), pair(SIDE), pair(SIDE * SIDE), pair(SIDE * SIDE + SIDE)};
    const Float8 all = __builtin_convertvector(__builtin_convertvector((Short8)pairs, Int8), Float8);
    const Float4 low = {all[0], all[1], all[2], all[3]}, high = {all[4], all[5], all[6], all[7]};
    const Float4 face = low + f[0] * (high - low);
    const Float4 edge = face + f[1] * (__builtin_shufflevector(face, face, 2, 3, 2, 3) - face);
    return edge[0] + f[2] * (edge[1] - edge[0]);
}

Float4 trace(const Volume& v, const float* start, const float* way, float length, float step, float termination) {
    const int count = int(std::ceil(length / step));
    const Float4 entry = {start[0], start[1], start[2], 0}, along = {way[0], way[1], way[2], 0};
    const Int4 last = {v.n[0] - 2, v.n[1] - 2, v.n[2] - 2, 0};
    const Float4 low = {0, 0, 0, 0}, high = {float(v.n[0] - 1), float(v.n[1] - 1), float(v.n[2] - 1), 0};
    float inverse[3];
    for (int axis = 0; axis < 3; axis++) inverse[axis] = 1 / (std::abs(way[axis]) < 1e-9f ? 1e-9f : way[axis]);
    Float4 sum = {0, 0, 0, 0};  // colour and opacity so far
    for (int k = 0; k < count;) {
        const float extent = std::min(length - k * step, step);
        Float4 p = entry + (k * step + extent / 2) * along;
        p = p > low ? p : low;
        p = p < high ? p : high;
        Int4 cell = __builtin_convertvector(p, Int4);
        cell = cell < last ? cell : last;
        const Int4 brick = cell >> LOG_BRICK;
        const size_t here = v.brick(brick[0], brick[1], brick[2]);
        if (const int d = v.distance[here]) {
            k = skip(brick, d, start, inverse, step, k);
            continue;
        }
        const float s = interpolate(&v.voxels[here * STRIDE], cell & (BRICK - 1), p - __builtin_convertvector(cell, Float4));
        Float4 sample = v.table[int(s) >> v.shift];
        if (extent < step && sample[3] > 0) sample *= -std::expm1(extent / step * std::log1p(-sample[3])) / sample[3];
        sum += (1 - sum[3]) * sample;
        ++k;
        if (1 - sum[3] <= termination) break;
    }
    return sum;
}

}  // namespace

extern "C" {

// Voxels in the order of `(x, y, z)`, z fastest. The volume lives as long as the process.
void* make_volume(const uint16_t* voxels, int nx, int ny, int nz) {
    Volume* v = new Volume{{nx, ny, nz}, {}, {}, {}, {}, {}, {}, 0};
    for (int axis = 0; axis < 3; axis++) v->bricks[axis] = (v->n[axis] - 2) / BRICK + 1;
    pack(*v, voxels);
    return v;
}

// `table`: 65536 >> shift entries of red, green, blue, opacity of a step, the colours already times the opacity.
void classify(void* volume, const float* table, int shift) {
    Volume& v = *static_cast<Volume*>(volume);
    v.shift = shift;
    v.table.resize(65536 >> shift);
    std::memcpy(v.table.data(), table, v.table.size() * sizeof(Float4));
    find_empty(v);
}

// Rays in grid coordinates, row by row; `picture` gets three floats a pixel.
void render(const void* volume, const float* entry, const float* along, const float* length, int width, int height, float step,
            float termination, int threads, float* picture) {
    const Volume& v = *static_cast<const Volume*>(volume);
    const int across = (width + TILE - 1) / TILE, tiles = across * ((height + TILE - 1) / TILE);
    std::atomic<int> next{0};
    auto work = [&] {
        for (int tile; (tile = next++) < tiles;)
            for (int y = tile / across * TILE; y < std::min(height, (tile / across + 1) * TILE); y++)
                for (int x = tile % across * TILE; x < std::min(width, (tile % across + 1) * TILE); x++) {
                    const size_t ray = size_t(y) * width + x;
                    const Float4 sum = trace(v, entry + 3 * ray, along + 3 * ray, length[ray], step, termination);
                    for (int channel = 0; channel < 3; channel++) picture[3 * ray + channel] = sum[channel];
                }
    };
    std::vector<std::thread> others;
    for (int i = 1; i < threads; i++) others.emplace_back(work);
    work();
    for (auto& thread : others) thread.join();
}

}  // extern "C"
