// Point clouds: two triangles for each point, placed and coloured from the bytes as they came (docs/clouds.md). No vertex buffers.
Shader "IrisSession/Points"
{
    Properties
    {
        _Unused ("", Float) = 0
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" "Queue" = "Geometry" "RenderPipeline" = "UniversalPipeline" }
        Pass
        {
            Name "IrisPoints"
            Tags { "LightMode" = "UniversalForward" }
            Cull Off

            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex Vert
            #pragma fragment Frag
            #pragma multi_compile_instancing
            #include "Packages/com.unity.render-pipelines.universal/ShaderLibrary/Core.hlsl"
            #include "IrisShared.hlsl"

            // Two words a point: x and y of its node; z, and 5 bits of red, 6 of green, 5 of blue.
            StructuredBuffer<uint> _IrisPoints;
            float4x4 _IrisLatticeToWorld;
            float _IrisPointSize;

            struct Attributes
            {
                uint vertex : SV_VertexID;
                UNITY_VERTEX_INPUT_INSTANCE_ID
            };

            struct Varyings
            {
                float4 positionCS : SV_POSITION;
                float3 color : TEXCOORD0;
                UNITY_VERTEX_OUTPUT_STEREO
            };

            Varyings Vert(Attributes input)
            {
                Varyings output = (Varyings)0;
                UNITY_SETUP_INSTANCE_ID(input);
                UNITY_INITIALIZE_VERTEX_OUTPUT_STEREO(output);
                uint corner = input.vertex % 6;
                uint at = 2 * (input.vertex / 6);
                uint xy = _IrisPoints[at];
                uint zc = _IrisPoints[at + 1];
                float3 node = float3(xy & 0xffff, xy >> 16, zc & 0xffff);
                uint color = zc >> 16;
                float3 place = mul(_IrisLatticeToWorld, float4(node, 1.0)).xyz;
                // Corners of a square that faces the eye: 0 1 2, 2 1 3.
                uint k = corner < 3 ? corner : (corner == 3 ? 2 : (corner == 4 ? 1 : 3));
                float2 side = float2(k & 1, k >> 1) - 0.5;
                place += _IrisPointSize * (side.x * UNITY_MATRIX_V[0].xyz + side.y * UNITY_MATRIX_V[1].xyz);
                output.positionCS = TransformWorldToHClip(place);
                output.color = float3(color >> 11, (color >> 5) & 63, color & 31) / float3(31.0, 63.0, 31.0);
                return output;
            }

            float4 Frag(Varyings input) : SV_Target
            {
                UNITY_SETUP_STEREO_EYE_INDEX_POST_VERTEX(input);
                return float4(IrisFinish(input.color), 1.0);
            }
            ENDHLSL
        }
    }
}
