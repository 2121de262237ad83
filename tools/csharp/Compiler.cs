// Compiles C# with Roslyn: one argument per response file, whose lines are options of csc. Compiled itself by mcs
// (C# 7).
//
// `-standard:FILE` is no option of csc: it names the netstandard.dll whose list of types a program may use of the
// libraries that it references. `-members:FILE`: see Members.cs.
using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using System.Reflection.Metadata;
using System.Reflection.PortableExecutable;
using System.Threading.Tasks;
using Microsoft.CodeAnalysis;
using Microsoft.CodeAnalysis.CSharp;
using Microsoft.CodeAnalysis.Emit;
using Microsoft.CodeAnalysis.Text;

static class Compiler
{
    const string Standard = "-standard:";
    const string Listed = "-members:";
    static readonly Dictionary<string, MetadataReference> References = new Dictionary<string, MetadataReference>();

    static int Main(string[] jobs)
    {
        int status = 0;
        foreach (string job in jobs) if (!Compile(File.ReadAllLines(job))) status = 1;
        return status;
    }

    static bool Compile(string[] options)
    {
        string standard = FindOption(options, Standard), members = FindOption(options, Listed);
        var arguments = CSharpCommandLineParser.Default.Parse(
            options.Where(each => !each.StartsWith(Standard) && !each.StartsWith(Listed)), Directory.GetCurrentDirectory(), null);
        if (arguments.Errors.Length > 0) return Report(arguments.Errors);
        if (!arguments.MetadataReferences.All(each => File.Exists(each.Reference))) return false; // did not compile
        var trees = arguments.SourceFiles.Select(file => CSharpSyntaxTree.ParseText(
            SourceText.From(File.ReadAllText(file.Path), System.Text.Encoding.UTF8), arguments.ParseOptions, file.Path));
        var compilation = CSharpCompilation.Create(
            arguments.CompilationName, trees, arguments.MetadataReferences.Select(each => Refer(each.Reference)),
            arguments.CompilationOptions);
        string path = Path.Combine(arguments.OutputDirectory, arguments.OutputFileName);
        string symbols = Path.ChangeExtension(path, ".pdb");
        using (var output = new MemoryStream())
        using (var lines = new MemoryStream())
        {
            var result = compilation.Emit(output, lines, options: arguments.EmitOptions
                .WithDebugInformationFormat(DebugInformationFormat.PortablePdb).WithPdbFilePath(symbols));
            if (!Report(result.Diagnostics) || !result.Success) return false;
            if (standard != null && !CheckTypes(output, standard, compilation)) return false;
            File.WriteAllBytes(path, output.ToArray());
            File.WriteAllBytes(symbols, lines.ToArray());
        }
        if (members != null) Members.Write(compilation, members);
        return true;
    }

    static string FindOption(string[] options, string name)
    {
        return options.Where(each => each.StartsWith(name)).Select(each => each.Substring(name.Length)).FirstOrDefault();
    }

    static MetadataReference Refer(string path)
    {
        if (!References.TryGetValue(path, out MetadataReference reference))
            References[path] = reference = MetadataReference.CreateFromFile(path);
        return reference;
    }

    static bool Report(IEnumerable<Diagnostic> diagnostics)
    {
        var shown = diagnostics.Where(each => each.Severity >= DiagnosticSeverity.Warning && !each.IsSuppressed).ToList();
        foreach (var each in shown) Console.Error.WriteLine(each);
        return shown.All(each => each.Severity != DiagnosticSeverity.Error);
    }

    // Types that the program refers to, less those of the list and of its own libraries.
    static bool CheckTypes(MemoryStream output, string standard, CSharpCompilation compilation)
    {
        var listed = new HashSet<string>();
        var own = new HashSet<string>();
        using (var file = File.OpenRead(standard))
        using (var reader = new PEReader(file))
        {
            var metadata = reader.GetMetadataReader();
            foreach (var handle in metadata.ExportedTypes)
            {
                var type = metadata.GetExportedType(handle);
                listed.Add(metadata.GetString(type.Namespace) + "." + metadata.GetString(type.Name));
            }
        }
        string folder = Path.GetDirectoryName(standard);
        foreach (var reference in compilation.References.OfType<PortableExecutableReference>())
            if (Path.GetDirectoryName(reference.FilePath) != folder) own.Add(Path.GetFileNameWithoutExtension(reference.FilePath));
        output.Position = 0;
        bool good = true;
        using (var reader = new PEReader(output, PEStreamOptions.LeaveOpen))
        {
            var metadata = reader.GetMetadataReader();
            foreach (var handle in metadata.TypeReferences)
            {
                var type = metadata.GetTypeReference(handle);
                if (type.ResolutionScope.Kind != HandleKind.AssemblyReference) continue; // nested: its outer type is listed
                string home = metadata.GetString(metadata.GetAssemblyReference((AssemblyReferenceHandle)type.ResolutionScope).Name);
                string name = metadata.GetString(type.Namespace) + "." + metadata.GetString(type.Name);
                if (own.Contains(home) || listed.Contains(name)) continue;
                Console.Error.WriteLine(compilation.AssemblyName + ": error: " + name + " is not a type of netstandard 2.1");
                good = false;
            }
        }
        return good;
    }
}
