// What all networks are made of, and the look-ups in the neural textures.

// The share that each level of textures counts is in its texels already.
struct Features {
    vec4 values[FEATURE_TEXELS];
};

vec3 linear_of(vec3 srgb) {
    return mix(pow((max(srgb, 0.04045) + 0.055) / 1.055, vec3(2.4)), srgb / 12.92, vec3(lessThanEqual(srgb, vec3(0.04045))));
}

vec4 leaky(vec4 x) { return max(x, LEAKY_SLOPE * x); }
vec3 softplus(vec3 x) { return max(x, 0.0) + log(1.0 + exp(-abs(x))); }
float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); }

// Four outputs of a layer whose inputs come in fours.
vec4 four(int at, vec4 x) {
    return fetch(weights, at) * x.x + fetch(weights, at + 1) * x.y + fetch(weights, at + 2) * x.z
        + fetch(weights, at + 3) * x.w;
}

// Bilinear look-ups in all levels of the texture of a row of `objects`.
Features look_up(int object, vec2 uv) {
    Features found;
    for (int k = 0; k < FEATURE_TEXELS; k++) found.values[k] = vec4(0.0);
    for (int level = 0; level < LEVELS; level++) {
        vec4 where = of_object(object, TEXTURE + level);
        int base = int(where.x), width = int(where.y), stride = int(where.z);
        vec2 at = clamp(vec2(uv.x, 1.0 - uv.y) * float(width) - 0.5, 0.0, float(width - 1));
        ivec2 low = ivec2(at), high = min(low + 1, width - 1);
        at -= vec2(low);
        for (int k = 0; k < FEATURE_TEXELS; k++) {
            vec4 a = fetch(texels, (base + low.y * stride + low.x) * FEATURE_TEXELS + k);
            vec4 b = fetch(texels, (base + low.y * stride + high.x) * FEATURE_TEXELS + k);
            vec4 c = fetch(texels, (base + high.y * stride + low.x) * FEATURE_TEXELS + k);
            vec4 e = fetch(texels, (base + high.y * stride + high.x) * FEATURE_TEXELS + k);
            found.values[k] += mix(mix(a, b, at.x), mix(c, e, at.x), at.y);
        }
    }
    return found;
}

// The first three bands of the spherical harmonics. Source: model/nets/pixel_mlp.py.
float[9] harmonics(vec3 d) {
    return float[9](
        0.28209479177387814, 0.4886025119029199 * d.y, 0.4886025119029199 * d.z, 0.4886025119029199 * d.x,
        1.0925484305920792 * d.x * d.y, 1.0925484305920792 * d.y * d.z,
        0.31539156525252005 * (3.0 * d.z * d.z - 1.0), 1.0925484305920792 * d.x * d.z,
        0.5462742152960396 * (d.x * d.x - d.y * d.y));
}
