// Everything of a scene that has triangles. No keywords but those of instancing and stereo, so that no variant is missing in a build.
Shader "IrisSession/Surface"
{
    Properties
    {
        // Vectors, not colours: the engine would convert those.
        _BaseColor ("Colour", Vector) = (1, 1, 1, 1)
        [NoScaleOffset] _BaseMap ("Texture", 2D) = "white" {}
        _Mapping ("0: none, 1: coordinates, 2: cube", Float) = 0
        _Highlight ("Highlight, and its exponent", Vector) = (0.5, 0.5, 0.5, 64)
        _Emission ("Emission", Float) = 0
        _SrcBlend ("Source blend", Float) = 1
        _DstBlend ("Target blend", Float) = 0
        _ZWrite ("Depth write", Float) = 1
        _Cull ("Cull", Float) = 2
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" "Queue" = "Geometry" "RenderPipeline" = "UniversalPipeline" }
        Pass
        {
            Name "IrisSurface"
            Tags { "LightMode" = "UniversalForward" }
            Blend [_SrcBlend] [_DstBlend], One [_DstBlend]
            ZWrite [_ZWrite]
            Cull [_Cull]

            HLSLPROGRAM
            #pragma target 3.5
            #pragma vertex Vert
            #pragma fragment Frag
            #pragma multi_compile_instancing
            #include "Packages/com.unity.render-pipelines.universal/ShaderLibrary/Core.hlsl"
            #include "IrisShared.hlsl"

            TEXTURE2D(_BaseMap);
            SAMPLER(sampler_BaseMap);

            CBUFFER_START(UnityPerMaterial)
                float4 _BaseColor;
                float4 _Highlight;
                float4 _BaseMap_TexelSize;
                float _Mapping;
                float _Emission;
                float _SrcBlend;
                float _DstBlend;
                float _ZWrite;
                float _Cull;
            CBUFFER_END

            struct Attributes
            {
                float4 positionOS : POSITION;
                float3 normalOS : NORMAL;
                float4 color : COLOR;
                float3 uv : TEXCOORD0;
                UNITY_VERTEX_INPUT_INSTANCE_ID
            };

            struct Varyings
            {
                float4 positionCS : SV_POSITION;
                float3 positionWS : TEXCOORD0;
                float3 normalWS : TEXCOORD1;
                float3 uv : TEXCOORD2;
                float4 color : TEXCOORD3;
                UNITY_VERTEX_OUTPUT_STEREO
            };

            Varyings Vert(Attributes input)
            {
                Varyings output = (Varyings)0;
                UNITY_SETUP_INSTANCE_ID(input);
                UNITY_INITIALIZE_VERTEX_OUTPUT_STEREO(output);
                output.positionWS = TransformObjectToWorld(input.positionOS.xyz);
                output.positionCS = TransformWorldToHClip(output.positionWS);
                output.normalWS = TransformObjectToWorldNormal(input.normalOS);
                output.uv = input.uv;
                output.color = input.color;
                return output;
            }

            float4 Frag(Varyings input, bool isFront : SV_IsFrontFace) : SV_Target
            {
                UNITY_SETUP_STEREO_EYE_INDEX_POST_VERTEX(input);
                float4 base = _BaseColor * input.color;
                float3 normal = SafeNormalize(input.normalWS) * (isFront ? 1.0 : -1.0);
                float3 toEye = normalize(GetCameraPositionWS() - input.positionWS);
                float3 forward = -UNITY_MATRIX_V[2].xyz;
                float4 seen = float4(IrisLight(input.positionWS, normal, toEye, forward, base.rgb, _Highlight, _Emission), base.a);
                if (_Mapping > 1.5) seen *= SAMPLE_TEXTURE2D_LOD(_BaseMap, sampler_BaseMap, IrisCubeUv(input.uv, _BaseMap_TexelSize.z), 0.0);
                else if (_Mapping > 0.5) seen *= SAMPLE_TEXTURE2D(_BaseMap, sampler_BaseMap, input.uv.xy);
                return float4(IrisFinish(seen.rgb), seen.a);
            }
            ENDHLSL
        }
    }
}
