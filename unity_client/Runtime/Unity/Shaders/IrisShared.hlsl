// What the shaders of iris-session share: lights by OpenGL's fixed pipeline as MuJoCo uses it, cube textures, and how grey the world
// is. Colours are blended as they are, without colour management (docs/scene.md); only at the end they become linear, because the
// project is in linear colour space. The same formulas as in web_client/src/view/surface.ts.
#ifndef IRIS_SHARED_INCLUDED
#define IRIS_SHARED_INCLUDED

#define IRIS_MAX_LIGHTS 8

// Set once a frame by LightingView.cs, in the world of the engine.
float _IrisDimmed;
float _IrisLightCount;
float4 _IrisLightPositions[IRIS_MAX_LIGHTS];   // w: 1 for a light from infinitely far
float4 _IrisLightDirections[IRIS_MAX_LIGHTS];  // w: cosine of the half angle of a spot, -2 for none
float4 _IrisLightAmbient[IRIS_MAX_LIGHTS];     // w: exponent of a spot
float4 _IrisLightDiffuse[IRIS_MAX_LIGHTS];
float4 _IrisLightSpecular[IRIS_MAX_LIGHTS];
float4 _IrisLightAttenuation[IRIS_MAX_LIGHTS]; // constant, linear, quadratic
float4 _IrisHeadlightAmbient;
float4 _IrisHeadlightDiffuse;
float4 _IrisHeadlightSpecular;

float3 IrisToLinear(float3 color)
{
    float3 low = color / 12.92;
    float3 high = pow(max((color + 0.055) / 1.055, 1e-5), 2.4);
    return lerp(high, low, step(color, 0.04045));
}

// Darker and greyer: what is shown is too old to act on.
float3 IrisFinish(float3 color)
{
    color = saturate(color);
    float grey = dot(color, float3(0.3, 0.59, 0.11));
    color = lerp(color, 0.45 * lerp(grey.xxx, color, 0.3), _IrisDimmed);
#ifdef UNITY_COLORSPACE_GAMMA
    return color;
#else
    return IrisToLinear(color);
#endif
}

float IrisHighlight(float3 normal, float3 toLight, float3 toEye, float exponent)
{
    return pow(max(dot(normal, normalize(toLight + toEye)), 1e-4), exponent);
}

float3 IrisShine(int i, float3 place, float3 normal, float3 toEye, float3 base, float4 highlight)
{
    float3 direction = _IrisLightDirections[i].xyz;
    float3 toLight = -direction;
    float share = 1.0;
    if (_IrisLightPositions[i].w < 0.5)
    {
        float3 way = _IrisLightPositions[i].xyz - place;
        float away = max(length(way), 1e-6);
        toLight = way / away;
        share = 1.0 / max(dot(_IrisLightAttenuation[i].xyz, float3(1.0, away, away * away)), 1e-6);
        float cutoff = _IrisLightDirections[i].w;
        if (cutoff > -1.5)
        {
            float along = dot(-toLight, direction);
            share *= along < cutoff ? 0.0 : pow(max(along, 1e-4), _IrisLightAmbient[i].w);
        }
    }
    float facing = max(dot(normal, toLight), 0.0);
    float3 direct = _IrisLightDiffuse[i].rgb * base * facing;
    if (facing > 0.0) direct += _IrisLightSpecular[i].rgb * highlight.rgb * IrisHighlight(normal, toLight, toEye, highlight.w);
    return share * (_IrisLightAmbient[i].rgb * base + direct);
}

// `highlight`: colour and exponent. `forward`: along the view.
float3 IrisLight(float3 place, float3 normal, float3 toEye, float3 forward, float3 base, float4 highlight, float emission)
{
    float3 lit = emission * base + _IrisHeadlightAmbient.rgb * base;
    float facing = max(dot(normal, -forward), 0.0);
    lit += _IrisHeadlightDiffuse.rgb * base * facing;
    if (facing > 0.0) lit += _IrisHeadlightSpecular.rgb * highlight.rgb * IrisHighlight(normal, -forward, toEye, highlight.w);
    for (int i = 0; i < (int)_IrisLightCount; i++) lit += IrisShine(i, place, normal, toEye, base, highlight);
    // As in the fixed pipeline: a texture multiplies what the lights gave after that was clamped.
    return min(lit, 1.0);
}

// Place in a texture of six faces one below another (right, left, up, down, front, back), by the table of OpenGL. `direction`: in the
// axes of the scene. Half a texel stays free at the edges of a face, so that nothing of the next one is mixed in.
float2 IrisCubeUv(float3 direction, float faceTexels)
{
    float3 size = abs(direction);
    float face, s, t, major;
    if (size.x >= size.y && size.x >= size.z)
    {
        major = size.x;
        face = direction.x > 0.0 ? 0.0 : 1.0;
        s = direction.x > 0.0 ? -direction.z : direction.z;
        t = -direction.y;
    }
    else if (size.y >= size.z)
    {
        major = size.y;
        face = direction.y > 0.0 ? 2.0 : 3.0;
        s = direction.x;
        t = direction.y > 0.0 ? direction.z : -direction.z;
    }
    else
    {
        major = size.z;
        face = direction.z > 0.0 ? 4.0 : 5.0;
        s = direction.z > 0.0 ? direction.x : -direction.x;
        t = -direction.y;
    }
    float margin = 0.5 / max(faceTexels, 1.0);
    float2 inFace = clamp(0.5 * float2(s, t) / max(major, 1e-6) + 0.5, margin, 1.0 - margin);
    // t counts from the first row, which is the highest; v of the engine from the lowest.
    return float2(inFace.x, 1.0 - (face + inFace.y) / 6.0);
}

#endif
