// What shines at the end of a light path: a surface, or the sky. Source: model/methods/light_path/net.py.

const int SLOT = 4 * FEATURE_TEXELS + 2, PATH_SLOTS = STACKED_FIRST + STACKED_SECOND, SLOTS = PATH_SLOTS + STRAIGHT;
const int STACK_INPUTS = SLOTS * SLOT + (STRAIGHT > 0 ? 4 : 0), STACK_OUTPUTS = 1 + (STRAIGHT > 0 ? (STRAIGHT + 3) / 4 : 0);
const int GROUPS = HIDDEN / 4, STACK_GROUPS = STACK_HIDDEN / 4;
// Where the layers begin among the weights; each has four outputs beside each other for every input, then its biases.
const int OTHERS = 1 + 9 * SEES_DIRECTIONS, WITHOUT_OTHERS = GROUPS * (4 * FEATURE_TEXELS + HIDDEN + 2) + HIDDEN + 1;
const int COLORS = 0, S_FIRST = WITHOUT_OTHERS + GROUPS * OTHERS, S_FIRST_BIAS = S_FIRST + STACK_GROUPS * STACK_INPUTS;
const int S_SECOND = S_FIRST_BIAS + STACK_GROUPS, S_SECOND_BIAS = S_SECOND + STACK_GROUPS * STACK_HIDDEN;
const int S_THIRD = S_SECOND_BIAS + STACK_GROUPS, S_THIRD_BIAS = S_THIRD + STACK_OUTPUTS * STACK_HIDDEN;
const int COVER = S_THIRD_BIAS + STACK_OUTPUTS, SKY = COVER + (STRAIGHT > 0 ? WITHOUT_OTHERS + GROUPS * 10 : 0);

// Where a ray meets the learned relief below, or above, a surface.
vec2 relieved(int object, Place place) {
#if RELIEF == 1
    vec4 where = of_object(object, TEXTURE + LEVELS);
    int base = int(where.x), width = int(where.y);
    vec2 at = clamp(vec2(place.uv.x, 1.0 - place.uv.y) * float(width) - 0.5, 0.0, float(width - 1));
    ivec2 low = ivec2(at), high = min(low + 1, width - 1);
    at -= vec2(low);
    ivec4 index = base + ivec4(low.y * width + low.x, low.y * width + high.x, high.y * width + low.x, high.y * width + high.x);
    vec4 depth;
    for (int k = 0; k < 4; k++) depth[k] = fetch(weights, index[k] / 4)[index[k] % 4];
    float here = mix(mix(depth.x, depth.y, at.x), mix(depth.z, depth.w, at.x), at.y);
    return clamp(place.uv + RELIEF_DEPTH * here * place.uv_slope, 0.0, 1.0);
#else
    return place.uv;
#endif
}

// What a network of two hidden layers makes of features, cosine and, with ten `others`, harmonics.
vec4 network(int first, int others, Features features, float cosine, float bands[9]) {
    int inputs = 4 * FEATURE_TEXELS + others, first_bias = first + GROUPS * inputs;
    int second = first_bias + GROUPS, second_bias = second + GROUPS * HIDDEN, third = second_bias + GROUPS;
    vec4 hidden[GROUPS], result = fetch(weights, third + HIDDEN);
    for (int g = 0; g < GROUPS; g++) {
        vec4 sum = fetch(weights, first_bias + g);
        int at = first + g * inputs;
        for (int k = 0; k < FEATURE_TEXELS; k++) sum += four(at + 4 * k, features.values[k]);
        at += 4 * FEATURE_TEXELS;
        sum += fetch(weights, at) * cosine;
        for (int k = 0; k < others - 1; k++) sum += fetch(weights, at + 1 + k) * bands[k];
        hidden[g] = leaky(sum);
    }
    for (int g = 0; g < GROUPS; g++) {
        vec4 sum = fetch(weights, second_bias + g);
        for (int k = 0; k < GROUPS; k++) sum += four(second + g * HIDDEN + 4 * k, hidden[k]);
        result += four(third + 4 * g, leaky(sum));
    }
    return result;
}

// Linear radiance that leaves the end of a branch.
vec3 decode(Features features, float cosine, vec3 reflected) {
    float bands[9];
#if SEES_DIRECTIONS == 1
    bands = harmonics(reflected);
#endif
    return softplus(network(COLORS, OTHERS, features, cosine, bands).rgb + features.values[0].rgb);
}

// Radiance from outside of the scene.
vec3 sky(vec3 d) {
    float azimuth = atan(d.y, d.x) / 3.141592653589793, polar = 2.0 * acos(clamp(d.z, -1.0, 1.0)) / 3.141592653589793 - 1.0;
    vec3 sum = vec3(0.0);
    int base = SKY;
    for (int level = 0; level < SKY_LEVELS; level++) {
        bool last = level == SKY_LEVELS - 1;
        int height = last ? 1 : SKY_HEIGHT >> level, width = last ? 1 : 2 * SKY_HEIGHT >> level;
        float x = 0.5 * (azimuth + 1.0) * float(width) - 0.5;
        float y = clamp(0.5 * (polar + 1.0) * float(height) - 0.5, 0.0, float(height - 1));
        int left = int(floor(x)), top = int(y), below = min(top + 1, height - 1);
        float right_share = x - float(left), below_share = y - float(top);
        int right = (left + 1) % width;
        left = (left + width) % width;
        vec3 upper = mix(fetch(weights, base + top * width + left).rgb, fetch(weights, base + top * width + right).rgb, right_share);
        vec3 lower = mix(fetch(weights, base + below * width + left).rgb, fetch(weights, base + below * width + right).rgb, right_share);
        sum += mix(upper, lower, below_share);
        base += width * height;
    }
    vec3 light = softplus(sum);
    for (int lobe = 0; lobe < LOBES; lobe++) {
        vec4 axis = fetch(weights, base + 2 * lobe);
        light += exp(axis.w * (dot(d, axis.xyz) - 1.0)) * fetch(weights, base + 2 * lobe + 1).rgb;
    }
    return light;
}

#if STACK_HIDDEN > 0
vec4 stacked[STACK_GROUPS];  // The sums of the stack network's first layer, of what the ray has met so far.

void begin_stack() {
    for (int g = 0; g < STACK_GROUPS; g++) stacked[g] = fetch(weights, S_FIRST_BIAS + g);
}

// What the stack network is told of one vertex.
void stack_slot(int slot, Features features, float through, float cosine) {
    for (int g = 0; g < STACK_GROUPS; g++) {
        int at = S_FIRST + g * STACK_INPUTS + slot * SLOT;
        for (int k = 0; k < FEATURE_TEXELS; k++) stacked[g] += four(at + 4 * k, features.values[k]);
        at += 4 * FEATURE_TEXELS;
        stacked[g] += fetch(weights, at) * through + fetch(weights, at + 1) * cosine;
    }
}
#endif
