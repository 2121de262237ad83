using System.Runtime.CompilerServices;

[assembly: InternalsVisibleTo("IrisSession.Core.Tests")]
