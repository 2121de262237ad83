// Lights of a scene by OpenGL's fixed pipeline, where their bodies are now. docs/scene.md, "Lights", is normative.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>One light, in the world and in the axes of the wire.</summary>
    public sealed class SceneLight
    {
        public readonly Light Spec;

        /// <summary>Cosine of the half angle of a spot; -2: it shines to all sides.</summary>
        public readonly float Cutoff;
        public readonly float Exponent;
        public readonly bool IsDirectional;

        internal SceneLight(Light spec)
        {
            Spec = spec;
            IsDirectional = spec.Kind == LightKind.Directional;
            bool isSpot = !IsDirectional && spec.Kind != LightKind.Point;
            Cutoff = isSpot && spec.Cutoff < 180.0 ? (float)Math.Cos(spec.Cutoff * Math.PI / 180.0) : -2f;
            Exponent = isSpot ? (float)spec.Exponent : 0f;
        }

        public Double3 Position { get; internal set; }

        /// <summary>Unit vector along which it shines.</summary>
        public Double3 Direction { get; internal set; }
    }

    /// <summary>Lights that are drawn. Placing them allocates nothing.</summary>
    public sealed class SceneLighting
    {
        /// <summary>Lights beyond these are left out, the last first. MuJoCo draws eight.</summary>
        public const int MaxLights = 8;
        public readonly IReadOnlyList<SceneLight> Lights;

        /// <summary>Active lights that are left out: too many, or of a kind that is not drawn.</summary>
        public readonly int LeftOut;

        private readonly Dictionary<long, RigidTransform> rest = new Dictionary<long, RigidTransform>();

        public SceneLighting(ScenePlan plan)
        {
            List<SceneLight> lights = new List<SceneLight>();
            foreach (SceneBody body in plan.Bodies) rest[body.Id] = body.T_world_body;
            foreach (Light light in plan.Spec.Lights)
            {
                if (!light.Active) continue;
                if (light.Kind == LightKind.Image || lights.Count == MaxLights) LeftOut++;
                else lights.Add(new SceneLight(light));
            }
            Lights = lights;
        }

        /// <summary>Move lights to where their bodies are.</summary>
        public void Place(IReadOnlyDictionary<long, RigidTransform> bodies)
        {
            for (int i = 0; i < Lights.Count; i++)
            {
                SceneLight light = Lights[i];
                Light spec = light.Spec;
                RigidTransform body = Find(bodies, spec.Body);
                Double3 place = new Double3(spec.PBody[0], spec.PBody[1], spec.PBody[2]);
                Double3 direction = new Double3(spec.DirectionBody[0], spec.DirectionBody[1], spec.DirectionBody[2]);
                // Keeps its orientation and its offset from the body, both of the pose in which the scene begins.
                bool isTracking = spec.Follow == Follow.Track || spec.Follow == Follow.TrackCom;
                DoubleQuaternion turn = isTracking && rest.TryGetValue(spec.Body, out RigidTransform begin) ? begin.Rotation : body.Rotation;
                light.Position = body.Position + turn.Rotate(place);
                direction = turn.Rotate(direction);
                bool isWatching = spec.Follow == Follow.TargetBody || spec.Follow == Follow.TargetBodyCom;
                if (isWatching && spec.Target >= 0)
                {
                    Double3 way = Find(bodies, spec.Target).Position - light.Position;
                    if (way.Length > 1e-6) direction = way;
                }
                double length = direction.Length;
                light.Direction = length > 0.0 ? (1.0 / length) * direction : new Double3(0.0, 0.0, -1.0);
            }
        }

        private RigidTransform Find(IReadOnlyDictionary<long, RigidTransform> bodies, long id)
        {
            if (bodies.TryGetValue(id, out RigidTransform pose) || rest.TryGetValue(id, out pose)) return pose;
            return RigidTransform.Identity;
        }
    }
}
