// What the shader is asked for: a picture, or what one ray meets.

// Which object the straight ray meets after so many others, and how far away.
vec4 layer_of(vec3 o, vec3 d, int layer) {
    Walk walk = Walk(o, NO_FACE, 0);
    Place place;
    Hit hit;
    for (int met = 0; met <= layer; met++) {
        hit = next_of(walk, OBJECTS_ROOT, d, place);
        if (hit.face == NO_FACE) return vec4(-1.0);
    }
    return vec4(float(hit.object), length(place.p - o), 0.0, 0.0);
}

void main() {
    ivec2 pixel = task == PICTURE ? ivec2(gl_FragCoord.x, size.y - gl_FragCoord.y) : ivec2(0);  // From the upper left.
    vec2 at = vec2(pixel) + in_pixel - 0.5 * size;
    vec3 d = normalize(camera_turn * vec3(at.x / focal, -at.y / focal, -1.0));
    if (task == LAYERS) {
        result = layer_of(camera_place, d, int(gl_FragCoord.x));
        return;
    }
    uint ray = (uint(pixel.y) * uint(size.x) + uint(pixel.x)) % chunk * samples + ray_sample;
    // The R2 sequence in whole numbers: 2^32 for 1.
    vec2 row = vec2(float(ray * R2_X), float(ray * R2_Y)) * 2.3283064365386963e-10;
#if LIGHT_PATH == 1
    asked = task == PATH ? int(gl_FragCoord.x) : -1, answer = vec4(-1.0);
#endif
    vec3 radiance = shade(camera_place, d, row, ray);
#if LIGHT_PATH == 1
    if (task == PATH) {
        result = answer;
        return;
    }
#endif
    result = vec4(radiance, 1.0) + keep * texelFetch(before, ivec2(gl_FragCoord.xy), 0);
}
