// Lights of the scene as numbers of the shaders, in the world of the engine, and how grey the world is.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;
using Light = IrisSession.Protocol.Light;

namespace IrisSession.Unity
{
    /// <summary>Sets what all shaders of the package share. Once a frame; allocates nothing.</summary>
    public sealed class LightingView
    {
        private readonly Vector4[] positions = new Vector4[SceneLighting.MaxLights];
        private readonly Vector4[] directions = new Vector4[SceneLighting.MaxLights];
        private readonly Vector4[] ambient = new Vector4[SceneLighting.MaxLights];
        private readonly Vector4[] diffuse = new Vector4[SceneLighting.MaxLights];
        private readonly Vector4[] specular = new Vector4[SceneLighting.MaxLights];
        private readonly Vector4[] attenuation = new Vector4[SceneLighting.MaxLights];

        /// <summary>Place the lights where their bodies are now.</summary>
        public void Show(SceneLighting lighting, ScenePlan plan, SceneBodies bodies)
        {
            lighting.Place(bodies.Poses);
            Matrix4x4 world = bodies.Root.localToWorldMatrix;
            IReadOnlyList<SceneLight> lights = lighting.Lights;
            for (int i = 0; i < lights.Count; i++)
            {
                SceneLight light = lights[i];
                Light spec = light.Spec;
                Vector3 place = world.MultiplyPoint3x4(UnityValues.ToVector3(UnityAxes.ToUnity(light.Position)));
                Vector3 way = world.MultiplyVector(UnityValues.ToVector3(UnityAxes.ToUnity(light.Direction)));
                positions[i] = new Vector4(place.x, place.y, place.z, light.IsDirectional ? 1f : 0f);
                directions[i] = new Vector4(way.x, way.y, way.z, light.Cutoff);
                ambient[i] = ToVector4(spec.Ambient, light.Exponent);
                diffuse[i] = ToVector4(spec.Diffuse, 0f);
                specular[i] = ToVector4(spec.Specular, 0f);
                attenuation[i] = ToVector4(spec.Attenuation, 0f);
            }
            Headlight headlight = plan.Spec.Environment.Headlight;
            float on = headlight.Active ? 1f : 0f;
            Shader.SetGlobalFloat(ShaderNames.LightCount, lights.Count);
            Shader.SetGlobalVectorArray(ShaderNames.LightPositions, positions);
            Shader.SetGlobalVectorArray(ShaderNames.LightDirections, directions);
            Shader.SetGlobalVectorArray(ShaderNames.LightAmbient, ambient);
            Shader.SetGlobalVectorArray(ShaderNames.LightDiffuse, diffuse);
            Shader.SetGlobalVectorArray(ShaderNames.LightSpecular, specular);
            Shader.SetGlobalVectorArray(ShaderNames.LightAttenuation, attenuation);
            Shader.SetGlobalVector(ShaderNames.HeadlightAmbient, ToVector4(headlight.Ambient, 0f, on));
            Shader.SetGlobalVector(ShaderNames.HeadlightDiffuse, ToVector4(headlight.Diffuse, 0f, on));
            Shader.SetGlobalVector(ShaderNames.HeadlightSpecular, ToVector4(headlight.Specular, 0f, on));
        }

        /// <summary>Draw the world darker and greyer: what it shows is too old to act on.</summary>
        public static void SetDimmed(bool isDimmed) { Shader.SetGlobalFloat(ShaderNames.Dimmed, isDimmed ? 1f : 0f); }

        private static Vector4 ToVector4(double[] rgb, float w, float scale = 1f)
        {
            return new Vector4(scale * (float)rgb[0], scale * (float)rgb[1], scale * (float)rgb[2], w);
        }
    }
}
