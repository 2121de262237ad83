using System.Runtime.CompilerServices;

[assembly: InternalsVisibleTo("IrisSession.Unity.StandinTests")]
