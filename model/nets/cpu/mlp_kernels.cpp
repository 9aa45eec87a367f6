// Layers of per-pixel networks, made for processors with AVX-512: what `model/mlp_kernels.py` builds and calls.
//
// A network is worked through in tiles of TILE pixels, small enough that what one step of a tile leaves behind is still
// in the caches when the next step reads it. Arrays are row-major with a row per pixel; `ld` is the number of floats
// from one row to the next. Rows of the library's own arrays are filled up with zeros to a multiple of PADDING floats
// (`padded`), those of the caller are not. Sums over pixels are taken tile by tile and then in the order of the tiles
// or threads, so that equal numbers of threads give equal bits.

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace {

// Of the processor's vector registers, 32 of 16 floats or 16 of 8, a block of a product fills three quarters.
#ifdef __AVX512F__
constexpr long LANES = 16, ROWS = 8;
#else
constexpr long LANES = 8, ROWS = 4;
#endif
constexpr long TILE = 64, PANEL = 3, PADDING = 16;

typedef float Vector __attribute__((vector_size(LANES * sizeof(float))));

Vector load(const float *from) {
    Vector value;
    std::memcpy(&value, from, sizeof value);
    return value;
}

void store(float *to, Vector value) { std::memcpy(to, &value, sizeof value); }

// As many floats as there are, `count` at most LANES, then zeros.
Vector load_some(const float *from, long count) {
    if (count >= LANES) return load(from);
    Vector value = {};
    for (long lane = 0; lane < count; lane++) value[lane] = from[lane];
    return value;
}

long padded(long width) { return (width + PADDING - 1) / PADDING * PADDING; }

long tiles_of(long pixels) { return (pixels + TILE - 1) / TILE; }

// Aligned memory of floats, zeroed.
class Buffer {
public:
    explicit Buffer(long size) : floats_(size + 16) {
        const auto address = reinterpret_cast<std::uintptr_t>(floats_.data());
        start_ = floats_.data() + (64 - address % 64) % 64 / sizeof(float);
    }
    Buffer(const Buffer &) = delete;
    float *get() { return start_; }

private:
    std::vector<float> floats_;
    float *start_;
};

// Which of `count` tiles each of `threads` takes: contiguous ones.
struct Share {
    long first, last;
    Share(long count, long thread, long threads)
        : first(count * thread / threads), last(count * (thread + 1) / threads) {}
};

Vector leaky(Vector value, float slope) { return value > 0 ? value : value * slope; }

// The slope of `leaky` at a value.
Vector leaky_slope(Vector value, float slope) { return value > 0 ? Vector{} + 1 : Vector{} + slope; }

// Calls finish(row, vector, start + a (ROWS, depth) b (depth, VECTORS * LANES)) for each row and vector. Number (r, d)
// of a is at a[r * row_step + d * depth_step], row r of start at start + r * ld_start.
template <int VECTORS, class Finish>
void multiply_block(const float *a, long row_step, long depth_step, const float *b, long ld_b, long depth,
                    const float *start, long ld_start, const Finish &finish) {
    Vector sum[ROWS][VECTORS];
    for (int row = 0; row < ROWS; row++)
        for (int v = 0; v < VECTORS; v++) sum[row][v] = load(start + row * ld_start + v * LANES);
    for (long d = 0; d < depth; d++) {
        Vector right[VECTORS];
        for (int v = 0; v < VECTORS; v++) right[v] = load(b + d * ld_b + v * LANES);
        for (int row = 0; row < ROWS; row++) {
            const float left = a[row * row_step + d * depth_step];
            for (int v = 0; v < VECTORS; v++) sum[row][v] += left * right[v];
        }
    }
    for (int row = 0; row < ROWS; row++)
        for (int v = 0; v < VECTORS; v++) finish(row, v, sum[row][v]);
}

// The same for any multiples of ROWS and LANES: calls finish(row, column, values).
template <class Finish>
void multiply(const float *a, long row_step, long depth_step, const float *b, long ld_b, long depth, const float *start,
              long ld_start, long rows, long columns, const Finish &finish) {
    for (long column = 0; column < columns; column += PANEL * LANES) {
        for (long row = 0; row < rows; row += ROWS) {
            const float *left = a + row * row_step, *right = b + column, *from = start + row * ld_start + column;
            const auto place = [&](int r, int v, Vector value) { finish(row + r, column + v * LANES, value); };
            const long vectors = (columns - column) / LANES;
            if (vectors >= 3)
                multiply_block<3>(left, row_step, depth_step, right, ld_b, depth, from, ld_start, place);
            if (vectors == 2)
                multiply_block<2>(left, row_step, depth_step, right, ld_b, depth, from, ld_start, place);
            if (vectors == 1)
                multiply_block<1>(left, row_step, depth_step, right, ld_b, depth, from, ld_start, place);
        }
    }
}

// Asks for memory that is needed a tile later.
void fetch(const float *from, long count) {
    for (long place = 0; place < count; place += 64 / sizeof(float)) __builtin_prefetch(from + place, 0, 2);
}

}  // namespace

extern "C" {

// Rows of `Made::numbers`. The last two are there as soon as the layer behind has been gone back through: the means
// over pixels of the gradient after the norm, and of that times the normalised value.
enum { SCALE, SHIFT, MEAN, INVERSE_DEVIATION, MEAN_GRADIENT, MEAN_PRODUCT, NUMBERS };

// What a layer made of a batch, and the norm and activation behind it: leaky(scale * y + shift).
struct Made {
    float *y;        // (pixels, padded(width))
    float *numbers;  // (NUMBERS, padded(width)); of layers without batch norm only scale and shift
    float slope;
    int has_norm;
};

// Batch norm in training; all (width).
struct Norm {
    const float *weight, *bias;
    float *running_mean, *running_variance;
    float epsilon, momentum;
};

// What a layer reads: `x` (pixels, width) itself, or what the layer before it made and, added to it, what another one
// made.
struct Input {
    const float *x;
    const Made *made, *skip;
};

}  // extern "C"

namespace {

const float *row_of(const Made &made, int row, long width) { return made.numbers + row * padded(width); }

// LANES numbers of what a layer made, as the next one reads them.
struct Reader {
    const float *y, *scale, *shift;
    float slope;
    Reader(const Made &made, long width)
        : y(made.y), scale(row_of(made, SCALE, width)), shift(row_of(made, SHIFT, width)), slope(made.slope) {}
    Vector read(long row_start, long c) const {
        return leaky(load(y + row_start + c) * load(scale + c) + load(shift + c), slope);
    }
};

// Rows [first, first + TILE) of a layer's input; zeros beyond the last pixel and the last column.
void load_tile(const Input &input, long width, long first, long pixels, float *tile) {
    const long wide = padded(width), rows = std::min(TILE, pixels - first);
    const long next = first + TILE, coming = std::max(0L, std::min(TILE, pixels - next));
    std::fill(tile + rows * wide, tile + TILE * wide, 0.0f);
    if (input.x) {
        fetch(input.x + next * width, coming * width);
        for (long row = 0; row < rows; row++)
            for (long c = 0; c < wide; c += LANES)
                store(tile + row * wide + c, load_some(input.x + (first + row) * width + c, width - c));
        return;
    }
    const Reader made(*input.made, width);
    fetch(made.y + next * wide, coming * wide);
    for (long row = 0; row < rows; row++)
        for (long c = 0; c < wide; c += LANES) store(tile + row * wide + c, made.read((first + row) * wide, c));
    if (!input.skip) return;
    const Reader skip(*input.skip, width);
    fetch(skip.y + next * wide, coming * wide);
    for (long row = 0; row < rows; row++)
        for (long c = 0; c < wide; c += LANES)
            store(tile + row * wide + c, load(tile + row * wide + c) + skip.read((first + row) * wide, c));
}

// LANES values of one pixel of y, with their distances from the mean in deviations, and the gradient after the norm.
struct Passed {
    Vector normal, gradient;
    Passed(const Made &made, long width, long row_start, long c, Vector upstream) {
        const Vector y = load(made.y + row_start + c);
        const Vector z = y * load(row_of(made, SCALE, width) + c) + load(row_of(made, SHIFT, width) + c);
        gradient = upstream * leaky_slope(z, made.slope);
        normal = Vector{};
        if (made.has_norm)
            normal = (y - load(row_of(made, MEAN, width) + c)) * load(row_of(made, INVERSE_DEVIATION, width) + c);
    }
};

}  // namespace

extern "C" {

// made->y = input weight^T + bias, and made->numbers; the norm's running statistics move on.
//
// weight (outputs, inputs); bias (outputs); norm: null without one.
void mlp_layer_forward(long pixels, long inputs, long outputs, const Input *input, const float *weight,
                       const float *bias, const Norm *norm, const Made *made, int threads) {
    const long wide_in = padded(inputs), wide_out = padded(outputs), tiles = tiles_of(pixels);
    Buffer right(inputs * wide_out), offset(wide_out);
    for (long out = 0; out < outputs; out++) {
        offset.get()[out] = bias[out];
        for (long in = 0; in < inputs; in++) right.get()[in * wide_out + out] = weight[out * inputs + in];
    }
    // Of each tile and column the mean, and the sum of squared distances from it.
    std::vector<float> of_tiles(norm ? tiles * 2 * wide_out : 0);
#pragma omp parallel num_threads(threads)
    {
        Buffer x(TILE * wide_in), last_tile(TILE * wide_out);
        const Share share(tiles, omp_get_thread_num(), omp_get_num_threads());
        for (long tile = share.first; tile < share.last; tile++) {
            const long first = tile * TILE, rows = std::min(TILE, pixels - first);
            load_tile(*input, inputs, first, pixels, x.get());
            float *y = made->y + first * wide_out, *target = rows == TILE ? y : last_tile.get();
            multiply(x.get(), wide_in, 1, right.get(), wide_out, inputs, offset.get(), 0, TILE, wide_out,
                             [&](long row, long c, Vector value) { store(target + row * wide_out + c, value); });
            if (rows < TILE) std::copy_n(target, rows * wide_out, y);
            for (long c = 0; norm && c < wide_out; c += LANES) {
                // About a value nearby, or a small spread around a large mean would be lost in rounding.
                const Vector near = load(target + c);
                Vector sum = {}, squares = {};
                for (long row = 0; row < rows; row++) {
                    const Vector distance = load(target + row * wide_out + c) - near;
                    sum += distance;
                    squares += distance * distance;
                }
                const Vector middle = sum / static_cast<float>(rows);
                store(of_tiles.data() + tile * 2 * wide_out + c, near + middle);
                store(of_tiles.data() + (tile * 2 + 1) * wide_out + c, squares - middle * sum);
            }
        }
    }
    float *numbers = made->numbers;
    std::fill_n(numbers, NUMBERS * wide_out, 0.0f);
    for (long out = 0; out < outputs; out++) {
        numbers[SCALE * wide_out + out] = 1;
        if (!norm) continue;
        // The tiles' moments together (Chan, Golub and LeVeque 1979).
        double count = 0, mean = 0, squares = 0;
        for (long tile = 0; tile < tiles; tile++) {
            const double rows = std::min(TILE, pixels - tile * TILE), total = count + rows;
            const double distance = of_tiles[tile * 2 * wide_out + out] - mean;
            squares += of_tiles[(tile * 2 + 1) * wide_out + out] + distance * distance * count * rows / total;
            mean += distance * rows / total;
            count = total;
        }
        const double inverse_deviation = 1 / std::sqrt(squares / count + norm->epsilon);
        const double scale = norm->weight[out] * inverse_deviation;
        numbers[SCALE * wide_out + out] = scale;
        numbers[SHIFT * wide_out + out] = norm->bias[out] - mean * scale;
        numbers[MEAN * wide_out + out] = mean;
        numbers[INVERSE_DEVIATION * wide_out + out] = inverse_deviation;
        norm->running_mean[out] += norm->momentum * (mean - norm->running_mean[out]);
        norm->running_variance[out] += norm->momentum * (squares / (count - 1) - norm->running_variance[out]);
    }
}

// From the gradient of a layer's output to those of its input, weight and bias.
//
// made: what the layer made; `upstream` is the gradient after its norm and activation, (pixels, padded(outputs)). Null
// for a layer that has neither, where `upstream` is that of y, (pixels, outputs).
// input_gradient (pixels, padded(inputs)): of what input->made became by its own norm and activation, or of input->x;
// `further`, of the same shape, is added to it. Null where nobody asks.
// weight_gradient (outputs, inputs), bias_gradient (outputs): written.
// norm_weight_gradient, norm_bias_gradient (inputs): those of the norm behind input->made, whose MEAN_GRADIENT and
// MEAN_PRODUCT are written, too. Null where it has none.
void mlp_layer_backward(long pixels, long inputs, long outputs, const Input *input, const float *weight,
                        const Made *made, const float *upstream, float *input_gradient, const float *further,
                        float *weight_gradient, float *bias_gradient, float *norm_weight_gradient,
                        float *norm_bias_gradient, int threads) {
    const long wide_in = padded(inputs), wide_out = padded(outputs), tiles = tiles_of(pixels);
    const long weight_rows = (outputs + ROWS - 1) / ROWS * ROWS, of_thread = weight_rows * wide_in + wide_out;
    Buffer right(outputs * wide_in);
    for (long out = 0; out < outputs; out++) std::copy_n(weight + out * inputs, inputs, right.get() + out * wide_in);
    const Made *before = norm_weight_gradient ? input->made : nullptr;
    std::vector<float> of_tiles(before ? tiles * 2 * wide_in : 0);
    // Of each thread the gradient of the weights, and in one more row that of the biases.
    Buffer of_threads(threads * of_thread);
#pragma omp parallel num_threads(threads)
    {
        Buffer x(TILE * wide_in), down(TILE * wide_out), back(TILE * wide_in), nothing(wide_in);
        float *weights = of_threads.get() + omp_get_thread_num() * of_thread, *biases = weights + weight_rows * wide_in;
        const Share share(tiles, omp_get_thread_num(), omp_get_num_threads());
        for (long tile = share.first; tile < share.last; tile++) {
            const long first = tile * TILE, rows = std::min(TILE, pixels - first);
            const long next = first + TILE, coming = std::max(0L, std::min(TILE, pixels - next));
            load_tile(*input, inputs, first, pixels, x.get());
            fetch(upstream + next * (made ? wide_out : outputs), coming * (made ? wide_out : outputs));
            if (made) fetch(made->y + next * wide_out, coming * wide_out);
            if (further) fetch(further + next * wide_in, coming * wide_in);
            // The gradient of y.
            std::fill_n(down.get(), TILE * wide_out, 0.0f);
            for (long c = 0; c < wide_out; c += LANES) {
                Vector bias = load(biases + c);
                for (long row = 0; row < rows; row++) {
                    const long start = (first + row) * wide_out;
                    Vector value;
                    if (made) {
                        const Passed passed(*made, outputs, start, c, load(upstream + start + c));
                        value = passed.gradient;
                        if (made->has_norm) {
                            value -= load(row_of(*made, MEAN_GRADIENT, outputs) + c);
                            value -= passed.normal * load(row_of(*made, MEAN_PRODUCT, outputs) + c);
                            value *= load(row_of(*made, SCALE, outputs) + c);
                        }
                    } else {
                        value = load_some(upstream + (first + row) * outputs + c, outputs - c);
                    }
                    store(down.get() + row * wide_out + c, value);
                    bias += value;
                }
                store(biases + c, bias);
            }
            multiply(down.get(), 1, wide_out, x.get(), wide_in, TILE, weights, wide_in, weight_rows, wide_in,
                             [&](long out, long c, Vector value) { store(weights + out * wide_in + c, value); });
            if (!input_gradient) continue;
            multiply(down.get(), wide_out, 1, right.get(), wide_in, outputs, nothing.get(), 0, TILE, wide_in,
                             [&](long row, long c, Vector value) { store(back.get() + row * wide_in + c, value); });
            for (long c = 0; c < wide_in; c += LANES) {
                Vector sum = {}, products = {};
                for (long row = 0; row < rows; row++) {
                    const long start = (first + row) * wide_in;
                    Vector value = load(back.get() + row * wide_in + c);
                    if (further) value += load(further + start + c);
                    store(input_gradient + start + c, value);
                    if (!before) continue;
                    const Passed passed(*before, inputs, start, c, value);
                    sum += passed.gradient;
                    products += passed.gradient * passed.normal;
                }
                if (!before) continue;
                store(of_tiles.data() + tile * 2 * wide_in + c, sum);
                store(of_tiles.data() + (tile * 2 + 1) * wide_in + c, products);
            }
        }
    }
    for (long in = 0; before && in < inputs; in++) {
        double sum = 0, products = 0;
        for (long tile = 0; tile < tiles; tile++) {
            sum += of_tiles[tile * 2 * wide_in + in];
            products += of_tiles[(tile * 2 + 1) * wide_in + in];
        }
        norm_bias_gradient[in] = sum;
        norm_weight_gradient[in] = products;
        before->numbers[MEAN_GRADIENT * wide_in + in] = sum / pixels;
        before->numbers[MEAN_PRODUCT * wide_in + in] = products / pixels;
    }
    std::fill_n(weight_gradient, outputs * inputs, 0.0f);
    std::fill_n(bias_gradient, outputs, 0.0f);
    for (int thread = 0; thread < threads; thread++) {
        const float *weights = of_threads.get() + thread * of_thread, *biases = weights + weight_rows * wide_in;
        for (long out = 0; out < outputs; out++) {
            for (long in = 0; in < inputs; in++) weight_gradient[out * inputs + in] += weights[out * wide_in + in];
            bias_gradient[out] += biases[out];
        }
    }
}

// A layer of a network that learns no more, its batch norm folded in.
struct FoldedLayer {
    long inputs, outputs;
    const float *weight;  // (inputs, padded(outputs))
    const float *bias;  // (padded(outputs))
    float slope;        // Of the LeakyReLU below zero; 1 without one.
    int adds;           // Not 0: what the layer two before made is added to what this one makes.
};

// Stacked layers of pixels, as a dataset has them, and the tables in which they are looked up.
struct Stacks {
    // Layer l of pixel p is place p * pixel_step + l * layer_step of object_id, 0 where empty, and of uv, two of 65535.
    const std::uint16_t *uv;
    const std::uint8_t *object_id;
    long pixel_step, layer_step, layers, features;
    const float *texels;  // (texel, features)
    const int *places;    // (3, objects): first row, size and stride of each object's texture
    // Null where the network is not told of the camera: world positions on the surfaces, where they are, and the
    // camera.
    const float *positions;  // (texel, 3)
    const int *position_places;
    const float *camera;  // (view, 3)
    long objects, pixels_per_view;
};

}  // extern "C"

namespace {

// The four texels around a point, and their weights: those of `model.texture.bilinear_taps`.
struct Taps {
    std::int32_t texels[4];
    float weights[4];

    Taps(const int *places, long objects, long object, float u, float v) {
        const int base = places[object], size = places[objects + object], stride = places[2 * objects + object];
        const float last = static_cast<float>(size - 1);
        float x = std::min(std::max(u * size - 0.5f, 0.0f), last);
        float y = std::min(std::max((1.0f - v) * size - 0.5f, 0.0f), last);
        const int left = static_cast<int>(x), top = static_cast<int>(y);
        x -= left, y -= top;
        const int upper = base + top * stride, lower = upper + (top < size - 1 ? stride : 0);
        const int right = left + (left < size - 1 ? 1 : 0);
        texels[0] = upper + left, texels[1] = upper + right, texels[2] = lower + left, texels[3] = lower + right;
        weights[0] = (1 - x) * (1 - y), weights[1] = x * (1 - y), weights[2] = (1 - x) * y, weights[3] = x * y;
    }

    void fetch_from(const float *table, long channels) const {
        for (const long texel : texels) fetch(table + texel * channels, channels);
    }

    float mix(const float *table, long channels, long c) const {
        float sum = 0;
        for (int tap = 0; tap < 4; tap++) sum += weights[tap] * table[texels[tap] * channels + c];
        return sum;
    }

    void mix_all(const float *table, long channels, float *target) const {
        const float *from[4];
        for (int tap = 0; tap < 4; tap++) from[tap] = table + texels[tap] * channels;
        long c = 0;
        for (; c + LANES <= channels; c += LANES)
            store(target + c, weights[0] * load(from[0] + c) + weights[1] * load(from[1] + c) +
                                  weights[2] * load(from[2] + c) + weights[3] * load(from[3] + c));
        for (; c < channels; c++) target[c] = mix(table, channels, c);
    }
};

// What the layers of a tile's pixels meet, and where in the network's inputs it belongs.
struct Hits {
    std::vector<long> targets;
    std::vector<Taps> looks, places;

    void clear() { targets.clear(), looks.clear(), places.clear(); }
};

bool is_empty(const Stacks &stacks, long pixel) {
    for (long layer = 0; layer < stacks.layers; layer++)
        if (stacks.object_id[pixel * stacks.pixel_step + layer * stacks.layer_step]) return false;
    return true;
}

// Lists what a tile of `rows` drawn pixels meets, and asks for the texels.
void list_hits(const Stacks &stacks, const long *drawn, long rows, long wide, Hits &hits) {
    const long channels = stacks.features + (stacks.positions ? 3 : 0);
    hits.clear();
    for (long row = 0; row < rows; row++) {
        for (long layer = 0; layer < stacks.layers; layer++) {
            const long place = drawn[row] * stacks.pixel_step + layer * stacks.layer_step;
            const long object = stacks.object_id[place] - 1L;
            if (object < 0) continue;
            const float u = stacks.uv[2 * place] / 65535.0f, v = stacks.uv[2 * place + 1] / 65535.0f;
            hits.targets.push_back(row * wide + layer * channels);
            hits.looks.emplace_back(stacks.places, stacks.objects, object, u, v);
            hits.looks.back().fetch_from(stacks.texels, stacks.features);
            if (!stacks.positions) continue;
            hits.places.emplace_back(stacks.position_places, stacks.objects, object, u, v);
            hits.places.back().fetch_from(stacks.positions, 3);
        }
    }
}

// The network's inputs of a tile, float32 (TILE, wide); zeros where a layer is empty.
void look_up(const Stacks &stacks, const long *drawn, const Hits &hits, float *x, long wide) {
    std::fill(x, x + TILE * wide, 0.0f);
    for (std::size_t hit = 0; hit < hits.targets.size(); hit++) {
        float *target = x + hits.targets[hit];
        hits.looks[hit].mix_all(stacks.texels, stacks.features, target);
        if (!stacks.positions) continue;
        const float *camera = stacks.camera + 3 * (drawn[hits.targets[hit] / wide] / stacks.pixels_per_view);
        float view[3], square = 0;
        for (long axis = 0; axis < 3; axis++) {
            view[axis] = camera[axis] - hits.places[hit].mix(stacks.positions, 3, axis);
            square += view[axis] * view[axis];
        }
        const float length = std::max(std::sqrt(square), 1e-12f);
        for (long axis = 0; axis < 3; axis++) target[stacks.features + axis] = view[axis] / length;
    }
}

// A network and the memory to work a tile through it.
class Drawer {
public:
    Drawer(const FoldedLayer *layers, long count)
        : layers_(layers),
          count_(count),
          widest_(find_widest(layers, count)),
          given_(TILE * widest_),
          buffers_(3 * TILE * widest_) {}

    // Where the inputs of a tile belong, float32 (TILE, padded(inputs)).
    float *inputs() { return given_.get(); }

    // What the network makes of the tile, (TILE, padded(outputs)).
    const float *draw() {
        const float *from = given_.get();
        for (long l = 0; l < count_; l++) {
            // What a layer adds is still there, of three buffers in turn.
            const float *skip = layers_[l].adds ? buffer(l - 2) : nullptr;
            work_through(layers_[l], from, skip, buffer(l));
            from = buffer(l);
        }
        return from;
    }

private:
    static long find_widest(const FoldedLayer *layers, long count) {
        long widest = 0;
        for (long l = 0; l < count; l++)
            widest = std::max({widest, padded(layers[l].inputs), padded(layers[l].outputs)});
        return widest;
    }

    float *buffer(long layer) { return buffers_.get() + layer % 3 * TILE * widest_; }

    // One layer of a tile; what it adds is as wide as what it makes.
    static void work_through(const FoldedLayer &layer, const float *x, const float *skip, float *made) {
        const long wide = padded(layer.outputs);
        multiply(x, padded(layer.inputs), 1, layer.weight, wide, layer.inputs, layer.bias, 0, TILE, wide,
                 [&](long row, long c, Vector value) {
                     value = leaky(value, layer.slope);
                     if (skip) value += load(skip + row * wide + c);
                     store(made + row * wide + c, value);
                 });
    }

    const FoldedLayer *layers_;
    long count_, widest_;
    Buffer given_, buffers_;
};

}  // namespace

extern "C" {

// What a network makes, (pixels, outputs), of its inputs `x`, (pixels, inputs).
void mlp_draw(long pixels, const float *x, const FoldedLayer *layers, long count, float *made, int threads) {
    const long inputs = layers[0].inputs, outputs = layers[count - 1].outputs, tiles = tiles_of(pixels);
    const Input input = {x, nullptr, nullptr};
#pragma omp parallel num_threads(threads)
    {
        Drawer drawer(layers, count);
#pragma omp for schedule(dynamic, 16)
        for (long tile = 0; tile < tiles; tile++) {
            const long first = tile * TILE, rows = std::min(TILE, pixels - first);
            load_tile(input, inputs, first, pixels, drawer.inputs());
            const float *drawn = drawer.draw();
            for (long row = 0; row < rows; row++)
                std::copy_n(drawn + row * padded(outputs), outputs, made + outputs * (first + row));
        }
    }
}

// Colours (pixel, 3) of stacked layers. Pixels without any layer are all of one colour, and drawn once.
void mlp_draw_stacks(long pixels, const Stacks *stacks, const FoldedLayer *layers, long count, float *colors,
                     int threads) {
    constexpr long TILES_AT_ONCE = 16;
    std::vector<char> is_drawn(pixels);
#pragma omp parallel for num_threads(threads)
    for (long pixel = 0; pixel < pixels; pixel++) is_drawn[pixel] = !is_empty(*stacks, pixel);
    std::vector<long> drawn, empty;
    for (long pixel = 0; pixel < pixels; pixel++) (is_drawn[pixel] ? drawn : empty).push_back(pixel);
    if (!empty.empty()) drawn.push_back(empty[0]);
    const long number = drawn.size(), tiles = tiles_of(number), wide = padded(layers[0].inputs);
    const auto rows_of = [&](long tile) { return std::min(TILE, number - tile * TILE); };
#pragma omp parallel num_threads(threads)
    {
        Drawer drawer(layers, count);
        Hits hits, next;
#pragma omp for schedule(dynamic, 1)
        for (long start = 0; start < tiles; start += TILES_AT_ONCE) {
            const long stop = std::min(tiles, start + TILES_AT_ONCE);
            list_hits(*stacks, drawn.data() + start * TILE, rows_of(start), wide, hits);
            for (long tile = start; tile < stop; tile++) {
                const long *of_tile = drawn.data() + tile * TILE;
                look_up(*stacks, of_tile, hits, drawer.inputs(), wide);
                // Texels of the next tile are on their way while this one is drawn.
                if (tile + 1 < stop) list_hits(*stacks, of_tile + TILE, rows_of(tile + 1), wide, next);
                const float *colors_of_tile = drawer.draw();
                for (long row = 0; row < rows_of(tile); row++)
                    std::copy_n(colors_of_tile + row * padded(3), 3, colors + 3 * of_tile[row]);
                std::swap(hits, next);
            }
        }
    }
    for (const long pixel : empty) std::copy_n(colors + 3 * empty[0], 3, colors + 3 * pixel);
}

}  // extern "C"
