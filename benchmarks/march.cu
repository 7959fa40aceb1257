// The march of `jvr` as one writes it by hand for a graphics card: a thread for each ray, the same samples, skips and end of a ray.
// Without a CUDA compiler the same function runs on the host, so that what it computes can be tested anywhere.

#include <cmath>
#include <cstdint>

#ifdef __CUDACC__
#include <cuda_runtime.h>
#define BOTH __host__ __device__
#else
#define BOTH
#endif

// Pointers all belong to the host, or all to the device. Voxels and bricks in the order of (x, y, z), z fastest; `table` has four numbers
// an entry: red, green, blue, extinction; `radius` is the `empty_radius` of `jvr.march.occupancy.Occupancy`; `rays` has seven rows of `count` numbers:
// entry, direction, length.
struct March {
    const float* voxels;
    const float* table;
    const uint8_t* radius;
    const float* rays;
    int n[3], bricks[3];
    int brick, entries, count;
    float low, high, dt, termination;
};

BOTH inline float at_least(float a, float b) { return a > b ? a : b; }
BOTH inline float at_most(float a, float b) { return a < b ? a : b; }
BOTH inline float mix(float a, float b, float f) { return a + f * (b - a); }

BOTH inline float sample(const March& m, const float* p) {
    int low[3];
    float f[3];
    for (int axis = 0; axis < 3; axis++) {
        const float floor = at_most(at_least(floorf(p[axis]), 0.0f), float(m.n[axis] - 2));
        low[axis] = int(floor);
        f[axis] = p[axis] - floor;
    }
    const float* v = m.voxels + (size_t(low[0]) * m.n[1] + low[1]) * m.n[2] + low[2];
    const size_t x = size_t(m.n[1]) * m.n[2], y = m.n[2];
    const float front = mix(mix(v[0], v[1], f[2]), mix(v[y], v[y + 1], f[2]), f[1]);
    const float back = mix(mix(v[x], v[x + 1], f[2]), mix(v[x + y], v[x + y + 1], f[2]), f[1]);
    return mix(front, back, f[0]);
}

// Segments to go on from distance `u`, 0 where there may be something to see.
BOTH inline int empty_segments(const March& m, const float* entry, const float* along, float u) {
    int brick[3];
    float p[3];
    for (int axis = 0; axis < 3; axis++) {
        p[axis] = entry[axis] + u * along[axis];
        brick[axis] = int(at_most(at_least(floorf(p[axis] / m.brick), 0.0f), float(m.bricks[axis] - 1)));
    }
    const int radius = m.radius[(size_t(brick[0]) * m.bricks[1] + brick[1]) * m.bricks[2] + brick[2]];
    if (radius == 0) return 0;
    float distance = 1e30f;
    for (int axis = 0; axis < 3; axis++) {
        if (along[axis] == 0) continue;
        const int face = (along[axis] > 0 ? brick[axis] + radius : brick[axis] + 1 - radius) * m.brick;
        distance = at_most(distance, (face - p[axis]) / along[axis]);
    }
    return int(at_most(at_least(ceilf(distance / m.dt - 1e-3f), 1.0f), 1e9f));
}

// Radiance of three channels and optical depth of ray `i`, and how many samples it took.
BOTH inline int trace(const March& m, int i, float* out) {
    float entry[3], along[3];
    for (int axis = 0; axis < 3; axis++) {
        entry[axis] = m.rays[size_t(axis) * m.count + i];
        along[axis] = m.rays[size_t(3 + axis) * m.count + i];
    }
    const float length = m.rays[size_t(6) * m.count + i];
    const int segments = int(ceilf(length / m.dt));
    const float scale = (m.entries - 1) / (m.high - m.low);
    float radiance[3] = {0, 0, 0}, tau = 0, clear = 1;
    int samples = 0;
    for (int k = 0; k < segments && clear > m.termination;) {
        const float extent = k < segments - 1 ? m.dt : length - k * m.dt, u = k * m.dt + extent / 2;
        if (const int skip = empty_segments(m, entry, along, u)) {
            k += skip;
            continue;
        }
        float p[3];
        for (int axis = 0; axis < 3; axis++) p[axis] = entry[axis] + u * along[axis];
        const float place = at_most(at_least((sample(m, p) - m.low) * scale, 0.0f), float(m.entries - 1));
        const int row = int(at_most(floorf(place), float(m.entries - 2)));
        const float *a = m.table + 4 * row, *b = a + 4, f = place - row;
        const float dtau = mix(a[3], b[3], f) * extent, opacity = -expm1f(-dtau);
        for (int c = 0; c < 3; c++) radiance[c] += clear * opacity * mix(a[c], b[c], f);
        tau += dtau;
        clear = expf(-tau);
        samples++;
        k++;
    }
    for (int c = 0; c < 3; c++) out[c] = radiance[c];
    out[3] = tau;
    return samples;
}

// `out`: four numbers a ray. Returns the samples taken.
extern "C" long long march_on_host(const March* m, float* out) {
    long long samples = 0;
    for (int i = 0; i < m->count; i++) samples += trace(*m, i, out + 4 * size_t(i));
    return samples;
}

#ifdef __CUDACC__
__global__ void every_ray(March m, float* out) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < m.count) trace(m, i, out + 4 * size_t(i));
}

// The same on the device, from arrays of the host; `milliseconds` of each of `repeats` launches, transfers left out. Returns CUDA's error.
extern "C" int march_on_device(const March* host, float* out, float* milliseconds, int repeats) {
    March m = *host;
    const size_t voxels = sizeof(float) * m.n[0] * m.n[1] * m.n[2], pixels = sizeof(float) * 4 * size_t(m.count);
    const size_t bricks = size_t(m.bricks[0]) * m.bricks[1] * m.bricks[2];
    struct {
        const void* from;
        size_t bytes;
        void* to;
    } copies[] = {{host->voxels, voxels, nullptr},
                  {host->table, sizeof(float) * 4 * m.entries, nullptr},
                  {host->radius, bricks, nullptr},
                  {host->rays, sizeof(float) * 7 * size_t(m.count), nullptr}};
    cudaError_t error = cudaSuccess;
    for (auto& copy : copies) {
        if (!error) error = cudaMalloc(&copy.to, copy.bytes);
        if (!error) error = cudaMemcpy(copy.to, copy.from, copy.bytes, cudaMemcpyHostToDevice);
    }
    float* pixels_there = nullptr;
    if (!error) error = cudaMalloc((void**)&pixels_there, pixels);
    m.voxels = (const float*)copies[0].to;
    m.table = (const float*)copies[1].to;
    m.radius = (const uint8_t*)copies[2].to;
    m.rays = (const float*)copies[3].to;
    cudaEvent_t begin, end;
    cudaEventCreate(&begin);
    cudaEventCreate(&end);
    // The first launch warms up.
    for (int launch = -1; launch < repeats && !error; launch++) {
        cudaEventRecord(begin);
        every_ray<<<(m.count + 127) / 128, 128>>>(m, pixels_there);
        error = cudaGetLastError();
        cudaEventRecord(end);
        if (!error) error = cudaEventSynchronize(end);
        if (!error && launch >= 0) error = cudaEventElapsedTime(milliseconds + launch, begin, end);
    }
    if (!error) error = cudaMemcpy(out, pixels_there, pixels, cudaMemcpyDeviceToHost);
    for (auto& copy : copies) cudaFree(copy.to);
    cudaFree(pixels_there);
    cudaEventDestroy(begin);
    cudaEventDestroy(end);
    return error;
}
#endif
